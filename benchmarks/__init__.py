"""Benchmarks: one script per question, ``python -m benchmarks`` runs the quick ones."""
