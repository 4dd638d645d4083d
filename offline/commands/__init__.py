"""The commands of `groundsbot-offline`: their options, and what each does with files.

In: the command line. Out: files and lines for the user. `drives`, `finished_maps`, `imports`, `logs` and `recordings`
define options and import nothing heavy; the other modules do the work. The paper has no such block.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
