"""Text encoders: MiniLM (default), CLIP (for published checkpoints), hashing (tests)."""

from controlmm.text.cache import encode_all
from controlmm.text.clip import ClipTextEncoder
from controlmm.text.encoder import TextEncoder, TextFeatures, check_same_encoder
from controlmm.text.hashing import HashingTextEncoder
from controlmm.text.minilm import MiniLmTextEncoder
from controlmm.text.prompt import check_prompt
from controlmm.text.registry import load_text_encoder

__all__ = [
    "ClipTextEncoder",
    "HashingTextEncoder",
    "MiniLmTextEncoder",
    "TextEncoder",
    "TextFeatures",
    "check_prompt",
    "check_same_encoder",
    "encode_all",
    "load_text_encoder",
]
