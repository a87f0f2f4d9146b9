"""Steps that are repeated, and work that a device records: told apart from what is launched by nothing but time."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from torch import Tensor

from dro_grasp.graphs import Repeated, repeat
from tests.helpers.capturing_cuda import DEVICE, CapturingCuda, Generator
from tests.helpers.fake_device import fake_device
from tests.helpers.recorded_work import record


def test_a_step_that_is_repeated_is_told_its_number(device: str) -> None:
    table = torch.tensor([1.0, 10.0, 100.0, 1000.0, 1e4]).to(device)

    def step(state: tuple[torch.Tensor, torch.Tensor], number: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        total, last = state
        return total + table.index_select(0, number), 2 * last + total

    begin = (torch.zeros(1).to(device), torch.ones(1).to(device))
    total, last = repeat(step, begin, 5)
    assert (total.item(), last.item()) == (11111.0, 32.0 + 8 * 1 + 4 * 11 + 2 * 111 + 1111)
    assert (begin[0].item(), begin[1].item()) == (0.0, 1.0)


def test_what_repeated_steps_make_and_cache_can_be_differentiated() -> None:
    kept: list[Tensor] = []

    def step(x: Tensor, number: Tensor) -> Tensor:
        if not kept:
            kept.append(torch.full((2,), 3.0))
        return x * kept[0]

    with torch.no_grad():
        end = repeat(step, torch.ones(2), 3)
    assert end.tolist() == [27.0, 27.0]
    factor = torch.ones(2, requires_grad=True)
    (factor * end * kept[0]).sum().backward()
    assert factor.grad is not None
    assert factor.grad.tolist() == [81.0, 81.0]
    end += 1  # nor is it forbidden to write to it
    followed = torch.ones(2, requires_grad=True)
    (gradient,) = torch.autograd.grad(repeat(step, followed, 3).sum(), followed)
    assert gradient.tolist() == [27.0, 27.0], "where gradients are asked for, they are there"


@dataclasses.dataclass(frozen=True)
class Given:
    """What the work of these tests is given."""

    values: Tensor
    missing: Tensor | None = None


def test_recorded_work_repeats_what_follows_from_tensors_and_the_generator(monkeypatch: pytest.MonkeyPatch) -> None:
    with fake_device() as device:
        seen, generator, calls = record(monkeypatch), torch.Generator(device), list[int]()
        total = torch.zeros(1).to(device)

        def work(given: Given) -> tuple[Tensor, Tensor]:
            calls.append(1)
            total.add_(given.values.sum())
            return given.values * 2, torch.rand(1, generator=generator, device=device)

        repeated, found, drawn = Repeated(work, generator), [], []
        for number in range(4):
            generator.manual_seed(number % 2)
            doubled, random = repeated(Given(torch.full((3,), float(number)).to(device)))
            found.append(doubled)
            drawn.append(random.item())
        assert [each.tolist() for each in found] == [[0.0] * 3, [2.0] * 3, [4.0] * 3, [6.0] * 3], "earlier results stay"
        assert drawn[0] == drawn[2] != drawn[1] == drawn[3]
        assert total.item() == 3 * (0 + 1 + 2 + 3)
        assert len(calls) == 2, "once for the first call, once to be recorded"
        assert repeated(Given(torch.ones(2).to(device)))[0].tolist() == [2.0, 2.0]
        assert len(calls) == 3, "another shape is launched"
        assert seen == {"recorded": 1, "repeated": 3}


def test_work_that_waits_is_not_recorded(monkeypatch: pytest.MonkeyPatch) -> None:
    with fake_device() as device:
        seen = record(monkeypatch)
        repeated = Repeated(lambda given: given.values * given.values.sum().item(), torch.Generator(device))
        found = [repeated(Given(torch.tensor([1.0, n]).to(device))).tolist() for n in (1.0, 2.0, 3.0)]
    assert found == [[2.0, 2.0], [3.0, 6.0], [4.0, 12.0]]
    assert [name.partition(":")[0] for name in seen] == ["refused"]


def test_work_on_the_cpu_is_never_recorded() -> None:
    calls = list[int]()
    repeated = Repeated(lambda given: calls.append(1) or given.values, torch.Generator())
    assert [repeated(Given(torch.full((1,), float(n)))).item() for n in range(3)] == [0.0, 1.0, 2.0]
    assert len(calls) == 3


@pytest.mark.usefixtures("as_users_have_it")
def test_after_a_refused_capture_numbers_are_drawn_and_memory_is_given_back(monkeypatch: pytest.MonkeyPatch) -> None:
    cuda = CapturingCuda(monkeypatch)
    generator, drawn = Generator(cuda), list[int]()

    def work(given: Given) -> Tensor:
        drawn.append(generator.draw())
        cuda.wait()
        return given.values

    repeated = Repeated(work, generator)  # type: ignore[arg-type]
    for _ in range(3):
        repeated(Given(torch.ones(1, device=DEVICE.type)))
    assert drawn == [1, 1, 2, 3], "once for the first call, once as it is refused, then as if nothing had been"
    assert cuda.default.draw() == 1
    assert not cuda.underway
    assert not cuda.users.total()


@pytest.mark.usefixtures("as_users_have_it")
def test_work_that_fails_as_it_is_captured_is_launched(monkeypatch: pytest.MonkeyPatch) -> None:
    cuda = CapturingCuda(monkeypatch)
    generator, drawn = Generator(cuda), list[int]()

    def work(given: Given) -> Tensor:
        drawn.append(generator.draw())
        if cuda.capturing:
            raise torch.OutOfMemoryError
        return given.values

    repeated = Repeated(work, generator)  # type: ignore[arg-type]
    for _ in range(2):
        repeated(Given(torch.ones(1, device=DEVICE.type)))
    assert drawn == [1, 1, 2]
    assert not cuda.underway
    assert not cuda.users.total()


@pytest.mark.usefixtures("as_users_have_it")
def test_repeated_steps_share_their_memory_and_recorded_work_has_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    cuda = CapturingCuda(monkeypatch)

    def step(state: Tensor, number: Tensor) -> Tensor:
        if len(state) == 3:
            cuda.wait()
        return state + number

    for size in (1, 2, 3, 4, 5):  # one of which is refused
        repeat(step, torch.zeros(size, device=DEVICE.type), 5)
    assert sorted(cuda.users.values()) == [0, 1], "what a refused one shared is shared no more"
    repeated = Repeated(lambda given: given.values, Generator(cuda))  # type: ignore[arg-type]
    repeated(Given(torch.ones(1, device=DEVICE.type)))
    repeat(step, torch.zeros(6, device=DEVICE.type), 5)
    assert sorted(cuda.users.values()) == [0, 1, 1]
    del repeated
    assert sorted(cuda.users.values()) == [0, 0, 1]


@pytest.mark.gpu
def test_a_gpu_goes_on_after_a_refused_capture() -> None:
    generator = torch.Generator("cuda")

    def work(given: Given) -> tuple[Tensor, Tensor]:
        noise = torch.rand(4, generator=generator, device="cuda")
        return given.values * given.values.sum().item(), noise + 0 * torch.rand(4, device="cuda")

    repeated = Repeated(work, generator)
    for number in range(3):
        values = torch.full((4,), float(number), device="cuda")
        generator.manual_seed(number)
        found, noise = repeated(Given(values))
        generator.manual_seed(number)
        assert torch.equal(noise, torch.rand(4, generator=generator, device="cuda"))
        assert torch.equal(found, 4 * number * values)
    torch.cuda.empty_cache()  # refused as long as anything counts as captured


@pytest.mark.gpu
def test_a_gpu_repeats_recorded_work_on_new_values() -> None:
    generator, weight = torch.Generator("cuda"), torch.ones(4, device="cuda", requires_grad=True)
    calls = list[int]()

    def work(given: Given) -> tuple[Tensor, ...]:
        calls.append(1)
        noise = torch.rand(4, generator=generator, device="cuda")
        return (*torch.autograd.grad((weight * given.values * noise).sum(), [weight]), noise)

    repeated = Repeated(work, generator)
    for number in range(5):
        values = torch.full((4,), float(number), device="cuda")
        generator.manual_seed(number)
        gradient, noise = repeated(Given(values))
        generator.manual_seed(number)
        assert torch.equal(noise, torch.rand(4, generator=generator, device="cuda"))
        torch.testing.assert_close(gradient, values * noise)
    assert len(calls) == 2
