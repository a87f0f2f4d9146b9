"""`dro-grasp hands`, `objects` and `weights`: names of hands and objects, and the shipped weights with their checksums."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Annotated, Any

import tyro

from dro_grasp.cli.inputs import Flag
from dro_grasp.cli.output import print_json, print_result, say
from dro_grasp.errors import WeightsError


@dataclass(frozen=True)
class Hands:
    """List hands by name. Any URDF or MJCF file works as well."""

    json: Flag = False  # Print one JSON object.

    def run(self) -> int:
        """Print names and their sources."""
        from dro_grasp.hands.library import hand_names

        names = hand_names()
        print_result(self.json, {"hands": names}, "hands", ["name", "from"], [*names.items()],
                     "also: the path of a URDF or MJCF file, FILE#LINK of a whole robot, or a robot_descriptions name")
        return 0


@dataclass(frozen=True)
class Objects:
    """List objects by name. Any mesh or point cloud file works as well."""

    json: Flag = False  # Print one JSON object.

    def run(self) -> int:
        """Print names and splits."""
        from dro_grasp.objects.catalogue import object_names

        names = object_names()
        print_result(self.json, {"objects": names}, "objects", ["name", "split"], [*names.items()],
                     "also: the path of a mesh or point cloud, or procedural_SEED for an object that a seed draws")
        return 0


@dataclass(frozen=True)
class List:
    """List the shipped weights with size, training data and checksum."""

    json: Flag = False  # Print one JSON object.

    def run(self) -> int:
        """Print the metadata of each file."""
        from dro_grasp.network.checkpoints import DEFAULT, describe_weights, weights_names

        found = [describe_weights(name) for name in weights_names()]
        rows = [[w["name"], w["parameters"], w["bytes"] / 1e6, trained_on(w["about"]), w["sha256"][:16]] for w in found]
        print_result(self.json, {"weights": found}, "weights", ["name", "parameters", "MB", "trained on", "sha256"], rows,
                     f"default: '{DEFAULT}'; `dro-grasp weights verify` checks the files")
        return 0


@dataclass(frozen=True)
class Verify:
    """Verify the checksums of weights, and load them.

    Example: dro-grasp weights verify
    """

    names: tyro.conf.Positional[tuple[str, ...]] = ()
    """Names of shipped weights, or paths of weights files; by default all shipped weights. The checksums are printed."""
    json: Flag = False  # Print one JSON object.

    def run(self) -> int:
        """Check all files, then report; the exit code is 2 if one is damaged."""
        from dro_grasp.network.checkpoints import SMALL, verify_weights, weights_names

        rows = []
        for name in self.names or (*weights_names(), *SMALL):
            try:
                rows.append({"name": name, "sha256": verify_weights(name), "error": None})
            except WeightsError as error:
                rows.append({"name": name, "sha256": None, "error": str(error)})
        damaged = [row for row in rows if row["error"]]
        if self.json:
            print_json({"ok": not damaged, "weights": rows})
        else:
            for row in rows:
                if row["error"]:
                    print(f"error: {row['error']}", file=sys.stderr)
                else:
                    say(f"{row['sha256']}  {row['name']}: ok")
        return 2 if damaged else 0


@dataclass(frozen=True)
class Weights:
    """List and check trained weights."""

    command: Annotated[List, tyro.conf.subcommand("list")] | Annotated[Verify, tyro.conf.subcommand("verify")]


def trained_on(about: dict[str, Any]) -> str:
    """Training data in one line."""
    data = about.get("data", {})
    if not data:
        return "-"
    hands = data.get("hands", {})
    return f"{data.get('grasps', 0):,} grasps, {len(hands)} hands, {data.get('objects', 0)} objects"
