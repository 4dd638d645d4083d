from .advice import advise

__all__ = [
    "advise",
]
