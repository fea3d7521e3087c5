"""Phase retrieval: one interface (``base``), one file per method."""
