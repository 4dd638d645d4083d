"""groundsbot-offline: from run logs to a map, and what goes with it. Heavy imports wait until a command runs."""

from groundsbot.calib.foundation import new_app
from groundsbot.calib.foundation import run as run_program
from groundsbot.offline.commands import (
    calibrate,
    compare,
    detect,
    export,
    import_recording,
    info,
    localize,
    map_command,
    salvage,
)

app = new_app(
    "Make one map of tags and trajectories from run logs; inspect, repair and import logs; compare and export maps."
)

app.command("import")(import_recording)
app.command("map")(map_command)
for _command in (calibrate, localize, info, salvage, detect, compare, export):
    app.command()(_command)


def main() -> None:
    """The program `groundsbot-offline`."""
    run_program(app)


if __name__ == "__main__":
    main()
