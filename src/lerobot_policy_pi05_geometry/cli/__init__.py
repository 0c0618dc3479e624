"""The commands of `pi05-geometry`, one file per thing that they are about. Each imports what it needs when it is called.

app   what they share        studies      demo, study                     simulation   record, train, evaluate
                             checkpoints  inspect, bench, convert, export, merge
                             datasets     quantiles, precompute           planning     plan
"""

from . import studies, simulation, checkpoints, datasets, planning  # noqa: F401, I001 (the order of --help)
from .app import app, console

__all__ = ["app", "console"]
