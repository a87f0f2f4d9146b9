"""What to say where fewer grasps are found than were asked for."""

from __future__ import annotations

from collections.abc import Mapping

from dro_grasp.pipeline.admission import PLANE
from dro_grasp.pipeline.problem import GraspProblem


def shortage_in_words(
    problem: GraspProblem, asked: int, found: int, made: int, dropped: Mapping[str, int], alone: bool
) -> str:
    """How many grasps there are, what candidates were dropped for, and what to do.

    Args:
        problem: With its constraints.
        asked: Grasps that were asked for.
        found: Grasps that there are.
        made: Candidates that were made.
        dropped: Candidates that the constraints rejected, by reason.
        alone: Whether one source alone made the candidates.
    """
    constraints, low, high = problem.constraints, *problem.height_range
    advice = {
        "table": f"lower table (now {constraints.table} m; the object spans z = {low:.3f} to {high:.3f} m)",
        "cone": f"widen cone (now {constraints.cone} rad)",
        "direction": "leave out direction, or give another one",
        "avoid": "check that the scene to avoid is in the object's frame, and leave out what may be touched",
        "hold": "enlarge the balls of hold",
        "spare": "make the balls of spare smaller",
        "opening": f"ask for less opening (now {constraints.opening} m)",
    }
    given = [words for name, words in advice.items() if getattr(constraints, name) not in (None, ())]
    if constraints.table is None and dropped.get(PLANE):
        given.append("state the table's height if it is lower than the one found in the cloud")
    given += ["use the method 'auto'"] if alone else []
    return (f"only {found} of {made} candidates on object '{problem.obj.name}' meet what was asked of them"
            f"{dropped_in_words(dropped)}; {asked} were asked for. {'; or '.join(['Try another seed', *given])}")


def dropped_in_words(dropped: Mapping[str, int]) -> str:
    """How many candidates were dropped, and why, in brackets; nothing for none."""
    reasons = ", ".join(f"{count} {reason}" for reason, count in dropped.items() if count)
    return f" (dropped: {reasons})" if reasons else ""
