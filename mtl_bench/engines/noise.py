"""When a row says that its machine was noisy."""

SPREAD = 0.25  # of (p95 - p5) / p50 of the passes
DRIFT = 0.05  # of the last quarter of the passes against the first, either way
