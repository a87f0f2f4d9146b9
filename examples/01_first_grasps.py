"""Sixteen grasps of an object that the weights have never seen: predict, refine, rank, evaluate and draw them."""

from pathlib import Path

import dro_grasp as dro

hand = dro.load_hand("allegro")
obj = dro.load_object("rubber_duck")
predictor = dro.GraspPredictor()

grasps = predictor.predict(hand, obj, num=16)
grasps = grasps.with_trial(dro.simulate(hand, obj, grasps))

out = Path("out")
out.mkdir(exist_ok=True)
grasps.save(out / "grasps.parquet")
dro.draw_grasps(hand, obj, grasps, out / "grasps.png")

print(f"{int(grasps.success.sum())} of {len(grasps)} hold under {grasps.protocol[0]}; see {out}/grasps.png")
