"""Lists of tag ids as text, as `0-23,40`."""

import re

from groundsbot.calib.errors import CalibError
from groundsbot.calib.tags.family import family_size

_PART = re.compile(r"(\d+)(?:-(\d+))?")


def parse_tag_ids(text: str, family: str) -> list[int]:
    """Return the ids of a list, in its order.

    Args:
        text: ids and ranges, including both ends, separated by commas.
        family: family of the tags.

    Raises:
        CalibError: the text has another form, or contains an id twice or one that the family does not have.
    """
    size = family_size(family)
    ids = list[int]()
    for part in text.split(","):
        found = _PART.fullmatch(part.strip())
        if found is None:
            raise CalibError(f"--ids is {text!r} but must read like 0-23,40; {part.strip()!r} is neither id nor range")
        first, last = int(found[1]), int(found[2] or found[1])
        if last >= size:
            raise CalibError(f"--ids names {last} but {family} has the ids 0 to {size - 1}; choose some of these")
        if last < first:
            raise CalibError(f"--ids holds {part.strip()!r}, which ends before it begins; write {last}-{first}")
        ids += range(first, last + 1)
    twice = next((each for each in ids if ids.count(each) > 1), None)
    if twice is not None:
        raise CalibError(f"--ids names {twice} twice; the tags of a building need distinct ids, name it once")
    return ids
