"""D(R,O) Grasp: any robot hand description in, simulation-checked dexterous grasps out.

    import dro_grasp as dro

    hand, obj = dro.load_hand("allegro"), dro.load_object("mug")   # names, or your own files
    grasps = dro.GraspPredictor().predict(hand, obj, num=16)       # the best first
    grasps = grasps.with_trial(dro.simulate(hand, obj, grasps))    # each tested in simulation
    grasps[grasps.success].save("grasps.parquet")
    dro.draw_grasps(hand, obj, grasps, "grasps.png")

Lengths are metres, angles radians, quaternions WXYZ; `T_a_b` takes coordinates in frame b to coordinates in frame a.

Public names are loaded on first use, so that importing the package costs nothing and training needs no simulator. They are
listed once, in `__init__.pyi`, which type checkers read as well.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
del lazy_loader
