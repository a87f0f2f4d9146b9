"""Nothing that is returned changes unless it is meant to."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch

from tests.golden.cases import CASES, RECORDED, digest, machine

RESULTS = json.loads(RECORDED.read_text())
CLOSELY_CHOSEN = {"grasps of a cloud"}
"""Cases where the best of many grasps differ by less than rounding does: elsewhere other ones are chosen, which score alike."""


def test_every_case_is_recorded() -> None:
    assert sorted(CASES) == sorted(RESULTS["cases"])


@pytest.mark.parametrize("name", CASES)
def test_results_are_those_that_were_recorded(name: str) -> None:
    torch.set_num_threads(1)
    recorded, numbers = RESULTS["cases"][name], CASES[name]()
    if machine() == RESULTS["machine"]:
        changed = [key for key, values in numbers.items() if [round(x, 5) for x in values[:40]] != recorded["numbers"].get(key)]
        assert digest(numbers) == recorded["sha256"], f"{name} changed ({', '.join(changed) or 'in late digits'}): see cases.py"
        return
    # Other processors and libraries round otherwise, and a contact may come out on the other side of a limit.
    for key, values in numbers.items():
        wanted = np.array(recorded["numbers"][key])
        if name in CLOSELY_CHOSEN:
            if key == "score":
                assert np.sort(values) == pytest.approx(np.sort(wanted), rel=0.2)
            continue
        close = np.isclose(values[:40], wanted, atol=0.02, rtol=0.05, equal_nan=True)  # NaN: no force was applied
        assert close.mean() >= 0.7, f"{name}: {key} differs"
