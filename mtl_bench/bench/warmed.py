"""Imported by the process that cells are forked from: what each of them would do alike, once.

The tasks' modules are imported and the package's code is fingerprinted. What a fork has beyond that
it reads itself, and what was edited since it reads anew. Python's collector passes over what is
here already: collecting before a timing took half a second.
"""

import gc
import importlib
import pkgutil

from mtl_bench import tasks
from mtl_bench.core.fingerprint import fingerprints
from mtl_bench.core.provenance import HARNESS_ROOTS

for _module in pkgutil.iter_modules(tasks.__path__, f"{tasks.__name__}."):
    importlib.import_module(_module.name)
for _stage, _begins in HARNESS_ROOTS.items():
    fingerprints(_stage, _begins)
gc.freeze()
