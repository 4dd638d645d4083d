"""`make bench`: figures that depend on the machine, so that no test does."""

import sys

from tests.benchmarks.speed import map_process

sys.exit(map_process.main())
