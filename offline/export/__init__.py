"""Export of a finished map for other tools: g2o, TUM, GeoJSON, FRC layouts, Limelight, CSV, Foxglove.

In: a map. Out: files, with units and frames as in docs/formats.md. The paper has no such block.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
