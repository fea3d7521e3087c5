"""Recovery of the inverse transmission matrix: one interface (``base``), one file per method."""
