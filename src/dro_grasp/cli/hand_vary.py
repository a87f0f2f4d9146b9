"""`dro-grasp hand vary`: a hand mirrored or scaled."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from dro_grasp.cli.inputs import Flag
from dro_grasp.cli.output import print_json, say


@dataclass(frozen=True)
class Vary:
    """Write the URDF of a hand's mirror image, or of a larger or smaller hand.

    Example: dro-grasp hand vary leaphand --mirrored --scale 0.95 --output leap_left_small.urdf
    """

    hand: tyro.conf.Positional[str]
    """Name of a hand, or path of a URDF file."""
    output: Path
    """URDF file to write. It names the hand's meshes by their absolute paths."""
    mirrored: Flag = False
    """Mirror it: a right hand becomes a left one. Equal joint values give mirrored poses."""
    scale: float = 1.0
    """Factor for all lengths; masses grow with its cube."""
    json: Flag = False
    """Print one JSON object instead of text."""

    def run(self) -> int:
        """Read, change, write."""
        from dro_grasp.errors import OptionError
        from dro_grasp.files import check_output, command, replacing
        from dro_grasp.hands.library import locate_hand
        from dro_grasp.hands.variants import vary_hand

        if not self.mirrored and self.scale == 1:
            raise OptionError("nothing would change; give --mirrored, --scale, or both")
        path = check_output(self.output, ".urdf")
        if path.exists() and path.samefile(locate_hand(self.hand).path):
            raise OptionError(f"{path} is the hand itself, which would be lost; give --output another name")
        text = vary_hand(self.hand, mirrored=self.mirrored, factor=self.scale)
        with replacing(path) as temporary:
            temporary.write_text(text)
        if self.json:
            print_json({"hand": self.hand, "mirrored": self.mirrored, "scale": self.scale, "output": str(self.output)})
        else:
            shown = command("dro-grasp", "hand", "check", self.output, "--picture", "hand.png")
            say(f"{self.output}; see it with: {shown}")
        return 0
