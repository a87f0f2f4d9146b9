"""The symmetric kernel, factorised and chunked, against the form of the paper and its release.

Naive form: features of both points concatenated for every pair, in both orders, a block of 4x4 at a time, through the
whole perceptron. Both forms get the same inputs (512 x 512 points, features of the paper's width with a latent), the same
weights, threads and matrix-product precision. Peak memory is the growth of the resident set in a new process of each form.

    python -m lab.benchmarks.kernel [--json] [--full] [--threads 1] [--seed 0]
"""

from __future__ import annotations

import contextlib
import multiprocessing
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from dro_grasp.devices import fast_products
from dro_grasp.network.distance_head import DistanceHead
from dro_grasp.network.presets import NetworkConfig
from lab.benchmarks.report import emit, options_of

BLOCKS = 4
"""Blocks along each side of the matrix in the naive form. Source: appendix, matrix block computation."""
RUNS = 5
"""Repetitions, of which the median time counts."""
FULL = 21
"""The same with `--full`."""

Form = Callable[[DistanceHead, Tensor, Tensor], Tensor]


def naive(
    head: DistanceHead, hand: Float[Tensor, "1 n d"], obj: Float[Tensor, "1 m d"]
) -> Float[Tensor, "1 n m"]:
    """Block by block, every pair concatenated."""
    return torch.cat([
        torch.cat([_block(head, rows, columns) for columns in obj.chunk(BLOCKS, 1)], 2) for rows in hand.chunk(BLOCKS, 1)
    ], 1)


def _block(
    head: DistanceHead, hand: Float[Tensor, "1 k d"], obj: Float[Tensor, "1 l d"]
) -> Float[Tensor, "1 k l"]:
    left = hand[:, :, None].expand(-1, -1, obj.shape[1], -1)
    right = obj[:, None].expand(-1, hand.shape[1], -1, -1)
    forwards = _perceptron(head, torch.cat([left, right], -1))
    backwards = _perceptron(head, torch.cat([right, left], -1))
    return functional.softplus(0.5 * (forwards + backwards))


def _perceptron(head: DistanceHead, x: Float[Tensor, "*b d"]) -> Float[Tensor, "*b"]:
    return head.last(functional.relu(head.second(functional.relu(head.first(x)))))[..., 0]


def factorised(
    head: DistanceHead, hand: Float[Tensor, "1 n d"], obj: Float[Tensor, "1 m d"]
) -> Float[Tensor, "1 n m"]:
    """The package's form."""
    return head(hand, obj)


FORMS: dict[str, Form] = {"naive, 4x4 blocks": naive, "factorised": factorised}


def case(seed: int) -> tuple[DistanceHead, Float[Tensor, "1 n d"], Float[Tensor, "1 m d"]]:
    """A kernel of the paper's size and features of one grasp."""
    torch.manual_seed(seed)
    config = NetworkConfig.preset("paper")
    width = config.width + config.latent
    head = DistanceHead(width, config.kernel_hidden, config.initial_distance)
    return head, torch.randn(1, config.n_hand, width), torch.randn(1, config.n_object, width)


def peak_memory(name: str, seed: int, threads: int, quick: bool) -> int:
    """Bytes that one evaluation adds at its peak, in this process. Linux only."""
    torch.set_num_threads(threads)
    head, hand, obj = case(seed)
    with torch.no_grad(), products(quick):
        # Once on a few points, so that thread pools and product kernels are not counted.
        FORMS[name](head, hand[:, :8], obj[:, :8])
        Path("/proc/self/clear_refs").write_text("5")
        before = _status("VmRSS")
        FORMS[name](head, hand, obj)
    return _status("VmHWM") - before


def _status(key: str) -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024 * next(int(line.split()[1]) for line in lines if line.startswith(key))


def products(quick: bool) -> contextlib.AbstractContextManager[None]:
    """The package's choice of precision, or PyTorch's default, for both forms alike."""
    return fast_products() if quick else contextlib.nullcontext()


def main() -> None:
    """Measure and print."""
    parser = options_of(__doc__)
    parser.add_argument("--full", action="store_true", help=f"{FULL} runs instead of {RUNS}")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--plain-products", action="store_true", help="PyTorch's default precision for both forms")
    options = parser.parse_args()
    if not sys.platform.startswith("linux"):
        parser.error("peak memory is read from /proc, which only Linux has")
    torch.set_num_threads(options.threads)
    quick = not options.plain_products
    head, hand, obj = case(options.seed)
    times: dict[str, list[float]] = {name: [] for name in FORMS}
    results: dict[str, Tensor] = {}
    with torch.no_grad(), products(quick):
        for form in FORMS.values():
            form(head, hand, obj)
        # Taking turns, so that whatever else the machine does hits both alike.
        for _ in range(FULL if options.full else RUNS):
            for name, form in FORMS.items():
                begin = time.perf_counter()
                results[name] = form(head, hand, obj)
                times[name].append(time.perf_counter() - begin)
    with multiprocessing.get_context("spawn").Pool(1, maxtasksperchild=1) as pool:
        memory = {name: pool.apply(peak_memory, (name, options.seed, options.threads, quick)) for name in FORMS}
    with torch.no_grad():
        exact = naive(head.double(), hand.double(), obj.double())
    deviation = {name: float(((d - exact) / exact).abs().max()) for name, d in results.items()}
    slow, fast = FORMS
    median = {name: statistics.median(t) for name, t in times.items()}
    between = float(((results[fast] - results[slow]) / results[slow]).abs().max())
    emit(
        f"Kernel over {hand.shape[1]} x {obj.shape[1]} pairs, one grasp, median of {len(times[fast])} runs, "
        f"{options.threads} thread(s), {'the package' if quick else 'PyTorch'}'s precision of products, seed {options.seed}",
        [[name, 1e3 * median[name], memory[name] / 2**20, f"{deviation[name]:.1e}"] for name in FORMS],
        ["form", "time [ms]", "peak memory [MiB]", "deviation from float64"],
        {
            "speedup": median[slow] / median[fast], "memory_ratio": memory[fast] / memory[slow],
            "max_relative_deviation": between, "max_relative_deviation_from_float64": deviation[fast],
            "milliseconds": 1e3 * median[fast], "threads": options.threads, "quick_products": quick,
        }, options.json,
    )


if __name__ == "__main__":
    main()
