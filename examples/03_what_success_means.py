"""The same grasps under four protocols, beside a control: half-closed hands at the object, never optimised."""

import dro_grasp as dro

hand = dro.load_hand("barrett")
obj = dro.load_object("rubber_duck")
sets = {
    "predicted": dro.GraspPredictor().predict(hand, obj, num=24),
    "predicted, not refined": dro.GraspPredictor().predict(hand, obj, num=24, refine=False),
    "never optimised": dro.palm_facing_starts(hand, obj, num=24, seed=0),
}
for protocol in ("dro", "strict", "dexgraspbench", "carry"):
    for name, grasps in sets.items():
        success = int(dro.simulate(hand, obj, grasps, protocol).success.sum())
        low, high = dro.wilson_interval(success, grasps.out_of)  # of what was asked for: grasps that were not found have failed
        print(f"{protocol:14} {name:22} {success:2} of {grasps.out_of}  (95 %: {low:.0%} to {high:.0%})")
