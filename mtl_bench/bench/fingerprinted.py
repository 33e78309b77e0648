"""Imported by the process that cells are forked from: reads the package's code once for them all.

What a fork has beyond that, it reads itself; what was edited since, it reads anew.
"""

from mtl_bench.core.fingerprint import fingerprints
from mtl_bench.core.provenance import HARNESS_ROOTS
from mtl_bench.core.quality import quality

for _stage, _begins in HARNESS_ROOTS.items():
    fingerprints(_stage, _begins)
quality()
