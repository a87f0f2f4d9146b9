"""From a hand and an object to the grasps that are worth trying: a source proposes candidates, and `finish` does the rest.

    GraspProblem(hand, obj) -> source.propose -> finish (refine, admit, score, settle, choose, ease) -> evaluate

Predictor, benchmark, arm, viewer, server and command line all go this way.
"""
