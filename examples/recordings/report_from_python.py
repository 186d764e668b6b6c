"""The interactive report of two recordings, from Python: ``report.html`` in this folder.

    python examples/recordings/report_from_python.py [BAG BAG]

The same as ``hpid metrics BAG BAG --report report.html``, with every number at hand.
"""

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from write_bag import write_bag

from hpid_bench.report.page import render_report
from hpid_ros.metrics import measure_all, summary
from hpid_ros.metrics.quantities import IAVC, ITAE, IVC


def main(bags, page=Path("report.html")):
    """Measure bags, print three ratios, write the report."""
    found = summary(measure_all(bags))
    labels = [run.label for run in found.comparison.runs]
    for quantity in (IVC, IAVC, ITAE):
        ratio = found.comparison.ratio(labels[-1], quantity)
        print(f"{quantity.symbol:5} {labels[-1]} / {labels[0]}  {ratio:.3f}")
    page.write_text(
        render_report(
            found.comparison,
            found.series,
            {"bags": [str(each) for each in bags]},
            found.parameters,
            warnings=found.warnings,
        ),
        encoding="utf-8",
    )
    print(f"written: {page}, {page.stat().st_size // 1000} kB")


if len(sys.argv) > 2:
    main([Path(each) for each in sys.argv[1:]])
else:
    with TemporaryDirectory() as folder:
        bags = [Path(folder) / "slow", Path(folder) / "fast"]
        for bag, rates in zip(bags, ((4.0, 8.0), (6.0, 12.0)), strict=True):
            write_bag(bag, rates)
        main(bags)
