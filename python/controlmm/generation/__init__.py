"""Masked decoding, objectives and editing."""
