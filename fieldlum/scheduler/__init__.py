"""Run units of work in this process, in several processes, or on a Dask cluster.

A stage turns its work into `WorkUnit`s and calls `run_units`. `parse_scheduler` reads the text of
the option `--scheduler`. Dask transports the units. This package checks that a worker has the same
fieldlum, profiles and input files, and limits what a lost, hanging or full worker can cost.
"""

from fieldlum.scheduler.address import LOCAL, Scheduler, in_processes, parse_scheduler
from fieldlum.scheduler.drive import run_each, run_units
from fieldlum.scheduler.units import SHARED_VARIABLE, UnitOutcome, WorkUnit, is_worker_trouble
