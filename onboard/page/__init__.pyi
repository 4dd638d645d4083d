from .recording import Addresses, record_watched

__all__ = ["Addresses", "record_watched"]
