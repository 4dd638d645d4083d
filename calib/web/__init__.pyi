from .endpoint import Access, Endpoint, listen_at, open_page, own_hosts, require_libraries
from .guard import Guard, content_policy, hash_source, refusal
from .page_address import LOOPBACK, PageAddress, PageText, parse_page_address
from .server import PageServer

__all__ = [
    "LOOPBACK",
    "Access",
    "Endpoint",
    "Guard",
    "PageAddress",
    "PageServer",
    "PageText",
    "content_policy",
    "hash_source",
    "listen_at",
    "open_page",
    "own_hosts",
    "parse_page_address",
    "refusal",
    "require_libraries",
]
