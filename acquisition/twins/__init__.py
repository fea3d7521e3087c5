"""Devices in software: the same registers and packets as the real ones, behind any transport."""
