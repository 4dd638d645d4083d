"""A finished map in the forms of other tools: g2o, TUM, GeoJSON, FRC layouts, Limelight, CSV.

In: a map. Out: files; docs/formats.md says units and frames of each. The paper has no such block.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
