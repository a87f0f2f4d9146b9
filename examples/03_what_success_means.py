"""The same grasps under three protocols, beside hands that were never moved towards a grasp."""

import dro_grasp as dro
from dro_grasp.evaluation.controls import palm_facing_starts
from dro_grasp.evaluation.metrics import wilson_interval

hand = dro.load_hand("barrett")
obj = dro.load_object("rubber_duck")
sets = {
    "predicted": dro.GraspPredictor().predict(hand, obj, num=24),
    "predicted, unpolished": dro.GraspPredictor().predict(hand, obj, num=24, refine=False),
    "never optimised": palm_facing_starts(hand, obj, num=24, seed=0),
}
for protocol in ("dro", "strict", "dexgraspbench"):
    for name, grasps in sets.items():
        success = int(dro.simulate(hand, obj, grasps, protocol).success.sum())
        low, high = wilson_interval(success, len(grasps))
        print(f"{protocol:14} {name:22} {success:2} of {len(grasps)}  (95 %: {low:.0%} to {high:.0%})")
