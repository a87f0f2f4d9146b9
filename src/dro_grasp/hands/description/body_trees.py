"""Which of the trees of bodies in an MJCF is the hand."""

from __future__ import annotations

from pathlib import Path

import mujoco

from dro_grasp.errors import HandError


def branches(root: mujoco.MjsBody) -> bool:
    """Whether a body and those below it move in several branches, as fingers do."""
    moves = lambda body: any(joint.type != mujoco.mjtJoint.mjJNT_FREE for joint in body.joints)  # noqa: E731
    return sum(moves(body) and not any(map(moves, body.find_all("body"))) for body in (root, *root.find_all("body"))) > 1


def hand_tree(spec: mujoco.MjSpec, path: Path, is_arm: bool) -> mujoco.MjsBody:
    """The root of the tree that branches, or else, and of an arm, of the one with the most joints.

    HandError: nothing moves, or several trees branch; the message names each.
    """
    roots = list(spec.worldbody.bodies)
    if not roots:
        raise HandError(f"{path} has no body; expected a hand with moving joints")
    counts = [sum(j.type != mujoco.mjtJoint.mjJNT_FREE for j in root.find_all("joint")) for root in roots]
    if max(counts) == 0:
        raise HandError(f"{path} has no moving joint; a hand needs at least one revolute or prismatic joint")
    hands = [] if is_arm else [root for root in roots if branches(root)]
    if len(hands) > 1:
        given = ", ".join(f"{path.name}#{root.name}" if root.name else "a body without name" for root in hands)
        raise HandError(f"{path} has {len(hands)} trees of bodies that move in branches, as fingers do; give the hand that you "
                        f"want: {given}")
    return hands[0] if hands else roots[counts.index(max(counts))]
