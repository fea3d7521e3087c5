"""Bayesian inference of polarisation parameters from Jones-matrix data."""

import lazy_loader

# names are imported when they are first asked for: a device's worker does not wait for a compiler it never uses
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
