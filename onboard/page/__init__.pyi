from .recording import record_with_page

__all__ = ["record_with_page"]
