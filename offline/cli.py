"""groundsbot-offline: from run logs to a map, and what goes with it. Heavy imports wait until a command runs."""

from groundsbot.calib.foundation import GroupedOptions, new_app
from groundsbot.calib.foundation import run as run_program
from groundsbot.offline.commands import (
    calibrate,
    compare,
    detect,
    export,
    import_recording,
    info,
    live,
    localize,
    map_command,
    salvage,
)
from groundsbot.offline.foundation import end_quickly

app = new_app(
    "Make one map of tags and trajectories from run logs; inspect, repair and import logs; compare and export maps."
)

_RECORDINGS, _MAPS, _RESULTS = "Recordings", "Maps", "Finished maps"
for _name, _command, _group, _example in (
    ("import", import_recording, _RECORDINGS, "import drive.bag -o recordings --tag-size-m 0.16"),
    ("info", info, _RECORDINGS, "info recordings"),
    ("salvage", salvage, _RECORDINGS, "salvage recordings/monday -o salvaged"),
    ("detect", detect, _RECORDINGS, "detect recordings/monday -o detected --family tag36h11"),
    ("map", map_command, _MAPS, "map recordings -o map --distance 3,12=8.34,0.01"),
    ("live", live, _MAPS, "live recordings/loop recordings/hallway -o map"),
    ("calibrate", calibrate, _MAPS, "calibrate recordings -o calibrated"),
    ("localize", localize, _MAPS, "localize friday --map map -o friday_in_map"),
    ("compare", compare, _RESULTS, "compare map --survey tags.csv --picture survey.png"),
    ("export", export, _RESULTS, "export map --format g2o -o map.g2o"),
):
    app.command(
        _name, cls=GroupedOptions, rich_help_panel=_group, epilog=f"\b\nExample:\n  groundsbot-offline {_example}"
    )(_command)


def main() -> None:
    """The program `groundsbot-offline`."""
    end_quickly()
    run_program(app)


if __name__ == "__main__":
    main()
