"""The route of the shipped orderings, priors and gains: element-wise arithmetic on arrays of pixels, no matrices."""

from .frame import fast_scene, fit_part, fit_responses, judge_states

__all__ = ["fast_scene", "fit_part", "fit_responses", "judge_states"]
