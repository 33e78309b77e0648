"""The five loss terms of the paper, and the two tasks that they belong to, for tests of methods."""

from mtl_bench.core.terms import Term

TERMS = (
    Term("semantic", "panoptic", "classification", 1.0),
    Term("center", "panoptic", "regression", 200.0),
    Term("offset", "panoptic", "regression", 0.01),
    Term("photometric", "depth", "regression", 1.0),
    Term("smoothness", "depth", "regression", 0.001),
)
PANOPTIC, DEPTH = TERMS[:3], TERMS[3:]
WHOLE_TASKS = (  # each the sum of its terms
    Term("panoptic", "panoptic", "classification", 1.0, PANOPTIC),
    Term("depth", "depth", "regression", 1.0, DEPTH),
)
