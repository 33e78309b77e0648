"""Step time and peak memory of every weighting method, over `fixed` and beside torchjd's.

    python benchmarks/methods_cost.py [--granularity terms] [--tasks 40] [NAME ...] > cost.md

The network is the real one: ResNet18, the recipe `small` (64 x 128, batch 4); with `--tasks K`
CelebA's cnn9 and K of its attributes (64 x 64, batch 16). A step is forward,
backward and method, for every method with its defaults; the optimiser's step is the same for all
and is left out. Every ratio is of two steps that ran one after the other, in alternating order, so
that what else the machine does cancels; medians over the rounds are printed, with quartiles. On one
CPU thread (OMP_NUM_THREADS=1) the process' own CPU time is taken, so that a busy machine will do;
else it is time on the wall, and the machine should be idle.

Peak memory is of three steps, from the method's construction on: what torch's allocator hands out
beyond parameters and batches, so activations, gradients and the method's state. Gradients are freed
between steps, as in training. On the CPU the profiler's record of the allocator tells it, which
leaves out what numpy, scipy and oneDNN allocate by themselves.

torchjd runs on the same losses, representation and parameters, at whichever of its settings proves
fastest in the same run; see `steps.py`.
"""

import argparse
import itertools
import platform
import statistics
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import torch
from steps import (
    AGGREGATORS,
    BASE,
    SETTINGS,
    TWO_BATCH_WEIGHTINGS,
    Bench,
    Setting,
    Step,
    aggregation,
    open_bench,
    our_step,
    torchjd_step,
)

from mtl_bench.core import cards, plugins
from mtl_bench.core.device import choose_device

# --- measuring ------------------------------------------------------------------------------------


def seconds(bench: Bench, step: Step) -> float:
    bench.clear()
    bench.wait()
    start = bench.clock()
    step()
    bench.wait()
    return bench.clock() - start


def rounds_of(
    bench: Bench, groups: Sequence[Mapping[str, Step]], count: int
) -> Iterator[list[dict[str, float]]]:
    """Round after round, the seconds of every step; those of a group run one after the other."""
    for number in range(count):
        found = []
        for group in groups:
            names = list(group)[:: 1 if number % 2 else -1]
            found.append({name: seconds(bench, group[name]) for name in names})
        print(f"round {number + 1} of {count}", file=sys.stderr)
        yield found


def peak_mib(bench: Bench, make: Callable[[], Step]) -> float:
    bench.clear()
    bench.wait()
    if bench.device.type == "cuda":
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
        run_three(bench, make)
        return (torch.cuda.max_memory_allocated() - before) / 2**20
    with torch.autograd.profiler.profile(profile_memory=True) as profiler:
        run_three(bench, make)
    events = [e for e in profiler.kineto_results.events() if e.name() == "[memory]"]
    changes = [e.nbytes() for e in sorted(events, key=lambda event: event.start_ns())]
    return max(itertools.accumulate(changes)) / 2**20


def run_three(bench: Bench, make: Callable[[], Step]) -> None:
    step = make()
    for _ in range(3):
        step()
        bench.clear()


@dataclass
class Result:
    name: str
    ours_s: list[float]
    base_s: list[float]
    torchjd_s: list[float]
    ours_mib: float
    torchjd_mib: float | None

    def over_base(self) -> list[float]:
        return [a / b for a, b in zip(self.ours_s, self.base_s, strict=True)]

    def over_torchjd(self) -> list[float]:
        return [a / b for a, b in zip(self.ours_s, self.torchjd_s, strict=False)]


def fastest_setting(bench: Bench, rounds: int) -> Setting:
    """By a method whose solver is cheap and for which all settings differ."""
    group = {str(s): torchjd_step(bench, "aligned", s) for s in SETTINGS}
    for step in group.values():
        seconds(bench, step)
    spent = [found[0] for found in rounds_of(bench, [group], rounds)]
    return min(SETTINGS, key=lambda s: statistics.median(found[str(s)] for found in spent))


def measure(
    bench: Bench, names: Sequence[str], rounds: int, setting: Setting | None
) -> Iterator[Result]:
    base = our_step(bench, BASE)
    groups = []
    for name in names:
        group = {"base": base, "ours": our_step(bench, name)}
        if setting is not None and name in {*AGGREGATORS, *TWO_BATCH_WEIGHTINGS}:
            try:
                group["torchjd"] = torchjd_step(bench, name, setting)
            except ImportError as error:  # some of its solvers are extras
                print(f"{name}: {error}", file=sys.stderr)
        groups.append(group)
        for step in group.values():
            seconds(bench, step)  # lazy initialisation
    spent = list(rounds_of(bench, groups, rounds))
    for index, (name, group) in enumerate(zip(names, groups, strict=True)):
        mine = [found[index] for found in spent]
        other = None
        if "torchjd" in group:
            assert setting is not None
            other = peak_mib(bench, partial(torchjd_step, bench, name, setting))
        yield Result(
            name,
            [found["ours"] for found in mine],
            [found["base"] for found in mine],
            [found["torchjd"] for found in mine if "torchjd" in found],
            peak_mib(bench, partial(our_step, bench, name)),
            other,
        )


# --- the table ------------------------------------------------------------------------------------

HEAD = [
    *("method", "cost", "step ms", f"over {BASE}", "peak MiB", f"over {BASE}"),
    *("torchjd ms", "ours / torchjd", "torchjd peak MiB"),
]


def spread(ratios: Sequence[float]) -> str:
    """Median and quartiles."""
    if len(ratios) < 2:
        return f"{ratios[0]:.3f}" if ratios else ""
    low, _, high = statistics.quantiles(ratios, n=4, method="inclusive")
    return f"{statistics.median(ratios):.3f} ({low:.3f} to {high:.3f})"


def table(results: Sequence[Result], costs: Mapping[str, str], base_mib: float) -> str:
    lines = [HEAD, ["---", "---", *["---:"] * (len(HEAD) - 2)]]
    for r in results:
        other = [f"{1000 * statistics.median(r.torchjd_s):.0f}"] if r.torchjd_s else [""]
        other += [spread(r.over_torchjd())]
        other += ["" if r.torchjd_mib is None else f"{r.torchjd_mib:.0f}"]
        ours = [f"{1000 * statistics.median(r.ours_s):.0f}", spread(r.over_base())]
        ours += [f"{r.ours_mib:.0f}", f"{r.ours_mib / base_mib:.2f}"]
        lines.append([r.name, costs[r.name], *ours, *other])
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def verdicts(results: Sequence[Result], costs: Mapping[str, str]) -> list[str]:
    """Whether the two aims are met, by the medians."""
    plain = [r for r in results if costs[r.name] == costs[BASE]]
    both = [r for r in results if r.torchjd_s]
    found = []
    if plain:
        worst = max(plain, key=lambda r: statistics.median(r.over_base()))
        percent = 100 * (statistics.median(worst.over_base()) - 1)
        found.append(
            f"Loss-value methods with one forward pass: at most {percent:+.1f} % over "
            f"{BASE} ({worst.name}; 2 % is the aim)."
        )
    if both:
        worst = max(both, key=lambda r: statistics.median(r.over_torchjd()))
        ratio = statistics.median(worst.over_torchjd())
        found.append(f"Ours over torchjd: at most {ratio:.3f} ({worst.name}; 1 is the aim).")
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help="methods (default: all)")
    parser.add_argument("--granularity", choices=("tasks", "terms"), default="tasks")
    parser.add_argument(
        "--tasks", type=int, help="in place of `small` the network cnn9 with so many attributes"
    )
    parser.add_argument("--recipe", default="small", help="smoke: only shows that it runs")
    parser.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto")
    parser.add_argument(
        "--rounds", type=int, default=15, help="four times as many for loss-value methods"
    )
    parser.add_argument("--quick", action="store_true", help="two rounds: only shows that it runs")
    given = parser.parse_args()
    device = choose_device(given.device)
    bench = open_bench(given.granularity, device, given.tasks, given.recipe)
    costs = {card.about.name: card.cost for card in cards.cards()}
    names = [plugins.path_of("methods", name).stem for name in given.names] or list(costs)
    rounds = 2 if given.quick else given.rounds
    loss_only = [name for name in names if "K" not in costs[name]]
    twins = {*AGGREGATORS, *TWO_BATCH_WEIGHTINGS}.intersection(names)
    setting = fastest_setting(bench, rounds) if twins and aggregation is not None else None
    results = list(measure(bench, loss_only, rounds if given.quick else 4 * rounds, None))
    rest = [name for name in names if name not in loss_only]
    results += measure(bench, rest, rounds, setting)
    where = platform.processor() or platform.machine()
    if bench.device.type == "cuda":
        where = torch.cuda.get_device_name()
    print(
        f"torch {torch.__version__} on {where}, {torch.get_num_threads()} threads; "
        f"K = {len(bench.terms)} ({given.granularity}); {rounds} rounds, "
        f"{len(results[0].ours_s)} of loss-value methods; torchjd: {setting or 'not run'}.\n"
    )
    print(table(results, costs, peak_mib(bench, partial(our_step, bench, BASE))))
    print("\n" + "\n".join([f"{cards.LEGEND}", *verdicts(results, costs)]))


if __name__ == "__main__":
    main()
