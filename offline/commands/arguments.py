"""Options and arguments that several commands of `groundsbot-offline` have."""

from pathlib import Path
from typing import Annotated

import typer

JsonFlag = Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")]
LogArguments = Annotated[
    list[Path], typer.Argument(metavar="LOG...", help="Log files, run folders or folders of runs.")
]
