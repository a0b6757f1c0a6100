"""Sparse models: equations that are evaluated, integrated, scored and stored."""
