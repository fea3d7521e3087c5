"""Phase retrieval in the amplitudes of the fibrelet modes: hundreds or thousands of numbers instead of a frame."""

from fibre.retrieval.modal.method import Modal

__all__ = ["Modal"]
