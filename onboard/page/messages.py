"""What the recorder and the page's process send each other.

The page's process faces the network, so that the recorder reads nothing from it but short JSON texts.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Literal, NamedTuple, get_args

from groundsbot.calib.foundation import printable
from groundsbot.calib.web import Access, PageAddress
from groundsbot.onboard.detection import Detection
from groundsbot.onboard.errors import OnboardError
from groundsbot.onboard.log import Picture
from groundsbot.onboard.page.preview import Preview
from groundsbot.onboard.page.viewer import LiveMessage, is_viewer_topic

MOST_NOTE: Final = 500  # characters of a note, after control characters are escaped
MOST_REPORT_BYTES: Final = 8192
TOKEN_NAME: Final = ".page_token"  # of the file that keeps the token

Act = Literal["start", "stop", "note"]


@dataclass(frozen=True)
class PageSettings:
    """Settings of the page's process."""

    robot_id: str
    access: Access | None  # who may open the page; None: there are only viewers
    side_px_m: float | None  # see make_preview
    viewer: PageAddress | None  # where viewers are served; None: nowhere
    cameras: tuple[str, ...] = ("",)  # names of the robot's cameras


class PageState(NamedTuple):
    """State of a recording, a capture or a check, in words."""

    name: str  # one word: recording, stopping, stopped; capturing, done; checking, checked, done
    rows: tuple[tuple[str, str, str], ...]  # label, text and rating of each line
    keeps_picture: bool = False  # the last picture is part of it, however old


class ToPage(NamedTuple):
    """What the recorder has for the page. The page answers when it has taken it."""

    state: PageState | None
    trouble: str  # why no run could be started; empty without trouble
    pictures: Mapping[str, tuple[Picture, Sequence[Detection]] | Preview]  # new ones, by camera
    head: Sequence[LiveMessage] | None  # of a run's log, where it is a new one
    messages: Sequence[LiveMessage]  # since the last ones, of the topics that viewers are subscribed to


class Answer(NamedTuple):
    """Result of a command."""

    number: int  # of the command
    refusal: str  # empty if it was done


class Command(NamedTuple):
    """A command from the page."""

    number: int
    act: Act
    text: str  # of a note


class Acknowledgement(NamedTuple):
    """Report that the page has taken what it was sent last, or that the number of its watchers changed."""

    is_answer: bool
    watchers: int


class Subscribed(NamedTuple):
    """Report of the topics that viewers are subscribed to."""

    topics: tuple[str, ...]


class Notice(NamedTuple):
    """Report with a line for the recorder's console."""

    text: str


Report = Command | Acknowledgement | Subscribed | Notice


def command_of(number: int, act: object, text: object) -> Command:
    """Return a command from untrusted values.

    Raises:
        OnboardError: it is not one of the commands, or has no usable note.
    """
    if act not in get_args(Act):
        raise OnboardError(f"command must be one of {', '.join(get_args(Act))}")
    note = printable(" ".join(text.split())) if isinstance(text, str) else ""
    if act == "note" and not 0 < len(note) <= MOST_NOTE:
        raise OnboardError(f"a note has {len(note)} characters; give 1 to {MOST_NOTE}")
    return Command(number, act, note if act == "note" else "")  # type: ignore[arg-type] # one of the words


def report_bytes(report: Report) -> bytes:
    """Return a report for the recorder as bytes."""
    return json.dumps([type(report).__name__, *report]).encode()


def parse_report(data: bytes) -> Report:
    """Return the report in bytes that the page's process sent.

    Raises:
        OnboardError: they are not a report.
    """
    try:
        match json.loads(data):
            case ["Command", int(number), act, text]:
                return command_of(number, act, text)
            case ["Acknowledgement", bool(is_answer), int(watchers)]:
                return Acknowledgement(is_answer, watchers)
            case ["Subscribed", [*topics]] if all(map(is_viewer_topic, topics)):
                return Subscribed(tuple(topics))
            case ["Notice", str(text)]:
                return Notice(printable(" ".join(text.split()))[:MOST_NOTE])
    except (ValueError, TypeError, RecursionError):
        pass
    raise OnboardError("the page's process sent what is not a report")
