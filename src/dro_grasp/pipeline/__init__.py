"""From a hand and an object to ranked, evaluated grasps: one problem, prepared once, and stages that return what they made.

    GraspProblem(hand, obj) -> propose -> refine -> rank -> evaluate

Predictor, viewer, benchmark, onboarding and command line call these stages and nothing else.
"""
