"""The simulated bench: a scene and its camera."""
