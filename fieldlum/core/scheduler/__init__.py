"""Run units of work in this process, in several processes, or on a Dask cluster.

A stage turns its work into `WorkUnit`s and calls `run_units`. `parse_scheduler` reads the text of
the option `--scheduler`. Units run by `concurrent.futures`, on a cluster through Dask's executor.
"""

from fieldlum.core.scheduler.address import LOCAL, Scheduler, in_processes, parse_scheduler
from fieldlum.core.scheduler.run import run_each, run_units
from fieldlum.core.scheduler.units import SHARED_VARIABLE, UnitOutcome, WorkUnit, is_worker_trouble
