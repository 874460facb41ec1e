"""`python3 make.py reference` and `python3 make.py measurements`: write the generated blocks, or check them."""

import argparse
import sys

from docs.generate import measurements, reference
from docs.generate.measurements import FIGURES


def main() -> int:
    parser = argparse.ArgumentParser(prog="make.py", description=__doc__)
    jobs = parser.add_subparsers(dest="job", required=True)
    described = jobs.add_parser("reference", help="the reference and the scenarios' JSON Schema, from the code")
    described.add_argument("--check", action="store_true", help="write nothing; exit 1 if something would change")
    measured = jobs.add_parser("measurements", help="the figures, from the commands behind them")
    measured.add_argument("names", nargs="*", metavar="NAME", help="these only: " + ", ".join(FIGURES))
    measured.add_argument("--timed", action="store_true", help="only those in real time; on an idle machine")
    measured.add_argument(
        "--check",
        action="store_true",
        help="only compare exact ones: NAMEs, or those of less than a minute that no test compares",
    )
    chosen = parser.parse_args()
    if chosen.job == "reference":
        return _reference(check=chosen.check)
    if unknown := set(chosen.names) - FIGURES.keys():
        parser.error(f"read {', '.join(sorted(unknown))}, wanted names from {', '.join(FIGURES)}")
    if not chosen.check:
        return min(1, measurements.measure(chosen.names or _unless_named(timed=chosen.timed)))
    names = chosen.names or [name for name, figure in FIGURES.items() if figure.kind == "exact"]
    differences = measurements.stale(name for name in names if FIGURES[name].exact)
    print("\n".join(differences), end="")
    return min(1, len(differences))


def _unless_named(*, timed: bool) -> list[str]:
    return [name for name, figure in FIGURES.items() if not (timed and figure.exact)]


def _reference(*, check: bool) -> int:
    found = reference.stale() if check else reference.write()
    for each in found:
        print(each)
    return 1 if check and found else 0


if __name__ == "__main__":
    sys.exit(main())
