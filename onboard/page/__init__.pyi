from .capturing import serve_capture
from .checking import serve_check
from .recording import Addresses, record_and_serve

__all__ = ["Addresses", "record_and_serve", "serve_capture", "serve_check"]
