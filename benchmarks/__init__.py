"""Speed measurements: ``python -m benchmarks.ops``."""
