"""Fly random experiments in virtual time and check that invariants hold: `python3 make.py soak --flights 1000`.

Each flight is drawn from the seed and its number (`soak_experiments.py`), flown through the product's own driver with
real bytes (`soak_flight.py`) and checked (`soak_checks.py`). A flight that breaks an invariant is written to a
folder; `--only NUMBER` or `--fly FILE` flies it again. Exit code 1 if any invariant is broken.
"""

import argparse
import os
import sys
import time  # noqa: TID251 - only to report how long the soak will take
import warnings
from collections import Counter
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path

from tests.soak.soak_experiments import Experiment, experiment
from tests.soak.soak_judge import Result, fly_numbers, judge

warnings.simplefilter("error")
BATCH = 8
"""The most flights that a process takes at a time."""


def fly_all(seed: int, numbers: range, workers: int) -> Iterator[tuple[int, Result]]:
    """All flights, in any order, flown in `workers` processes."""
    if workers == 1:
        for number in numbers:
            yield from fly_numbers(seed, [number])
        return
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        size = min(BATCH, -(-len(numbers) // workers))
        batches = [list(numbers[k : k + size]) for k in range(0, len(numbers), size)]
        for future in as_completed([pool.submit(fly_numbers, seed, batch) for batch in batches]):
            yield from future.result()


def soak(results: Iterable[tuple[int, Result]], count: int, seed: int, folder: Path) -> int:
    """Collect the results, show progress and print a summary; returns how many flights broke an invariant."""
    began_s = time.monotonic()
    counts: Counter[str] = Counter()
    failed: list[int] = []
    for done, (number, result) in enumerate(results, 1):
        counts[f"refused: {result.refused}" if result.refused else f"flown: {result.ended or 'not to its end'}"] += 1
        kinds = {f"BROKEN: {one.invariant}" for one in result.broken}
        counts.update(sorted(kinds))
        if result.broken:
            failed.append(number)
            tell(number, seed, result, folder)
        left_s = (time.monotonic() - began_s) / done * (count - done)
        if sys.stderr.isatty() or done % 100 == 0:
            text = f"{done} of {count} flights, {len(failed)} broken, {left_s:.0f} s left"
            print(text, file=sys.stderr, end="\r" if sys.stderr.isatty() else "\n", flush=True)
    taken_s = time.monotonic() - began_s
    for text, times in sorted(counts.items(), key=lambda entry: (entry[0].split(":")[0], -entry[1], entry[0])):
        print(f"{times:7d}  {text}")
    print(f"{count} flights of seed {seed} in {taken_s:.0f} s; {len(failed)} broke an invariant: {sorted(failed)}")
    return len(failed)


def tell(number: int, seed: int, result: Result, folder: Path) -> None:
    """Save the experiment, and print what it broke and how to fly it again."""
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / f"soak-{seed}-{number}.toml"
    experiment(seed, number).save(file)
    for broken in result.broken:
        print(f"seed {seed}, flight {number}: {broken.invariant}: {broken.text}", flush=True)
    print(f"    again: python3 make.py soak --fly {file}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flights", type=int, default=200, metavar="N")
    parser.add_argument("--seed", type=int, default=1, metavar="S")
    parser.add_argument("--first", type=int, default=0, metavar="K", help="number of the first flight")
    parser.add_argument("--only", type=int, metavar="K", help="fly this flight alone, in this process")
    parser.add_argument("--fly", type=Path, metavar="FILE", help="fly a failed experiment again")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, metavar="W", help="default: all processors")
    parser.add_argument("--out", type=Path, default=Path("runs/soak"), metavar="DIR", help="for failed experiments")
    asked = parser.parse_args()
    if asked.fly is not None:
        result = judge(Experiment.load(asked.fly))
        print(result.refused or result.ended)
        for broken in result.broken:
            print(f"{broken.invariant}: {broken.text}")
        sys.exit(1 if result.broken else 0)
    numbers = range(asked.first, asked.first + asked.flights)
    if asked.only is not None:
        numbers = range(asked.only, asked.only + 1)
    workers = 1 if asked.only is not None else max(1, asked.workers)
    sys.exit(1 if soak(fly_all(asked.seed, numbers, workers), len(numbers), asked.seed, asked.out) else 0)


if __name__ == "__main__":
    main()
