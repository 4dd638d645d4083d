"""Multi-robot smoothing and mapping with AprilTags: the public names of the library (docs/library.md).

Each name is loaded when it is first used, so that `import groundsbot` takes no time. The code lives in the packages
`groundsbot.calib`, `groundsbot.onboard`, `groundsbot.offline` and `groundsbot.fixtures`; docs/architecture.md is their
map. In the repository these are the folders of the same names at its top, which this folder links to.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
