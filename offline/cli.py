"""groundsbot-offline: from run logs to a map, and what goes with it. Heavy imports wait until a command runs."""

from groundsbot.calib.command_line import new_app
from groundsbot.calib.command_line import run as run_program
from groundsbot.offline.drives_cli import calibrate, localize, map_command
from groundsbot.offline.finished_map_cli import compare, export
from groundsbot.offline.import_cli import import_recording
from groundsbot.offline.logs_cli import detect, info, salvage

app = new_app("Turns run logs into one map of tags and trajectories, and tells what is in them.")

app.command("import")(import_recording)
app.command("map")(map_command)
for _command in (calibrate, localize, info, salvage, detect, compare, export):
    app.command()(_command)


def main() -> None:
    """The program `groundsbot-offline`."""
    run_program(app)


if __name__ == "__main__":
    main()
