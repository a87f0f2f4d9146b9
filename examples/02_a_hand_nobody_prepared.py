"""A URDF that was written a moment ago: check it, then synthesize its first grasps from geometry alone."""

from collections import Counter
from pathlib import Path

import dro_grasp as dro

BOX = '<geometry><box size="0.09 0.07 0.02"/></geometry>'
PALM = f'<link name="palm"><visual>{BOX}</visual><collision>{BOX}</collision></link>'
BAR = "".join(
    f'<{kind}><origin xyz="0 0 0.035"/><geometry><box size="0.014 0.014 0.07"/></geometry></{kind}>'
    for kind in ("visual", "collision"))


def finger(name: str, x: float, y: float, axis: str) -> str:
    """URDF of two links; the outer joint follows the inner one."""
    limit = '<limit lower="0" upper="1.4" effort="5" velocity="2"/>'
    return (
        f'<link name="{name}_near">{BAR}</link><link name="{name}_far">{BAR}</link>'
        f'<joint name="{name}_base" type="revolute"><parent link="palm"/><child link="{name}_near"/>'
        f'<origin xyz="{x} {y} 0.01"/><axis xyz="{axis}"/>{limit}</joint>'
        f'<joint name="{name}_tip" type="revolute"><parent link="{name}_near"/><child link="{name}_far"/>'
        f'<origin xyz="0 0 0.07"/><axis xyz="{axis}"/>{limit}<mimic joint="{name}_base" multiplier="0.6"/></joint>')


fingers = [finger("left", -0.04, 0.02, "0 1 0"), finger("right", -0.04, -0.02, "0 1 0"), finger("thumb", 0.04, 0.0, "0 -1 0")]
out = Path("out")
out.mkdir(exist_ok=True)
path = out / "my_hand.urdf"
path.write_text(f'<robot name="my_hand">{PALM}{"".join(fingers)}</robot>')

for line in dro.check_hand(path).lines():
    print(line)
hand = dro.load_hand(path)
obj = dro.load_object("can")
grasps = dro.synthesize(hand, obj, num=64)[:16]
result = dro.simulate(hand, obj, grasps)
print(f"{int(result.success.sum())} of the best {len(grasps)} synthesized grasps hold; the others fail as follows:")
print(dict(Counter(failure.value for failure in result.failure if failure)))
