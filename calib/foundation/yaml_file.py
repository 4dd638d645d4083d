"""Strict reading of YAML, and pydantic's validation errors as one line."""

import difflib
import re
import reprlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, TypeVar, cast

import yaml
from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from groundsbot.calib.errors import CalibError
from groundsbot.calib.foundation.files import atomic_write, read_regular

Model = TypeVar("Model", bound=BaseModel)

_LONGEST_VALUE = 60  # characters of a bad value that a message repeats
# Each alias may stand for all content before it, so that a short text can exhaust the memory.
_MOST_ALIASES: Final = 16
# In characters; parsing takes about a second. Logs contain such texts, and a log may come from an untrusted source.
LONGEST_TEXT: Final = 1 << 17
_MOST_BYTES: Final = 16 << 20
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)")

_SHORT = reprlib.Repr()  # a full repr of repeated aliases may take gigabytes
_SHORT.maxlong = _SHORT.maxstring = _SHORT.maxother = _LONGEST_VALUE + 1
_SHORT.maxdict = _SHORT.maxlist = _SHORT.maxset = 12
_SHORT.maxlevel = 3


class _Loader(yaml.SafeLoader):
    """Loader with YAML 1.2's core scalars: 1e-3 is a number, `no` a string, 010 ten. Duplicate keys are errors."""

    n_aliases = 0

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            self.n_aliases += 1
            if self.n_aliases > _MOST_ALIASES:
                mark = self.peek_event().start_mark  # type: ignore[no-untyped-call]  # PyYAML's stubs have no types for it
                raise yaml.MarkedYAMLError(problem=f"more than {_MOST_ALIASES} aliases", problem_mark=mark)
        return super().compose_node(parent, index)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key_node, _ in node.value:
            if key_node.value in seen and isinstance(key_node, yaml.ScalarNode):
                raise yaml.MarkedYAMLError(problem=f"{key_node.value} is given twice", problem_mark=key_node.start_mark)
            seen.add(key_node.value if isinstance(key_node, yaml.ScalarNode) else id(key_node))
        return super().construct_mapping(node, deep=deep)


def _use_yaml_1_2_scalars() -> None:
    """Replace PyYAML's YAML 1.1 rules in `_Loader`, not in PyYAML's own loaders."""
    _Loader.yaml_implicit_resolvers = {}
    for tag, pattern, first_characters in (
        ("null", r"(~|null|Null|NULL|)$", ["~", "n", "N", ""]),
        ("bool", r"(true|True|TRUE|false|False|FALSE)$", list("tTfF")),
        ("int", r"[-+]?[0-9]+$", list("-+0123456789")),
        ("float", rf"({_FLOAT.pattern})$", list("-+.0123456789")),
        ("merge", r"<<$", ["<"]),
    ):
        _Loader.add_implicit_resolver(f"tag:yaml.org,2002:{tag}", re.compile(pattern), first_characters)
    _Loader.add_constructor("tag:yaml.org,2002:int", lambda _, node: int(node.value))
    _Loader.add_constructor("tag:yaml.org,2002:float", lambda _, node: float(re.sub(r"\.(?=[inIN])", "", node.value)))


_use_yaml_1_2_scalars()


def read_text(path: Path) -> str:
    """Return the text of a file.

    Raises:
        CalibError: the file is missing, unreadable, not a regular file, too large, or not UTF-8.
    """
    try:
        return read_regular(path, _MOST_BYTES).decode().replace("\r\n", "\n").replace("\r", "\n")
    except OSError as error:
        raise CalibError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    except UnicodeDecodeError as error:
        raise CalibError(f"{path}: is not text in UTF-8 (byte {error.start}); is this the right file?") from error


def parse_mapping(text: str, source: str, longest: int = LONGEST_TEXT) -> dict[str, Any]:
    """Parse a YAML text that consists of one mapping.

    Args:
        text: YAML.
        source: name of the text in errors, usually the path.
        longest: limit of its length in characters.

    Raises:
        CalibError: the text is too long, not YAML, or not a mapping.
    """
    if len(text) > longest:
        raise CalibError(f"{source}: has {len(text)} characters, limit {longest}; is this the right file?")
    try:
        # _Loader derives from SafeLoader, which constructs plain data only.
        data = yaml.load(text, Loader=_Loader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        place = f"line {mark.line + 1}, column {mark.column + 1}: " if mark else ""
        raise CalibError(f"{source}: {place}not valid YAML ({error.problem}); correct that line") from error
    except (yaml.YAMLError, RecursionError) as error:
        raise CalibError(f"{source}: not valid YAML ({error}); correct it") from error
    except (ValueError, TypeError, KeyError, AttributeError, IndexError) as error:  # raised by PyYAML's constructors
        reason = " ".join(str(error).split())[:_LONGEST_VALUE]
        raise CalibError(f"{source}: not valid YAML ({reason}); write plain `field: value` lines") from error
    if not isinstance(data, dict):
        raise CalibError(f"{source}: holds {_abbreviate(data)} where fields were expected; write `field: value` lines")
    return cast(dict[str, Any], data)


def validate(model: type[Model], data: Mapping[str, Any], source: str) -> Model:
    """Return `data` as a `model`.

    Raises:
        CalibError: the data do not fit the model; one line on the first error: file, field, value, limit, way out.
    """
    try:
        return model.model_validate(dict(data))
    except ValidationError as error:
        # A default that could not be computed from a bad value is not an error of its own.
        problems = [each for each in error.errors(include_url=False) if each["type"] != "default_factory_not_called"]
        more = f" (and {len(problems) - 1} more after that)" if len(problems) > 1 else ""
        raise CalibError(f"{source}: {_explain(model, problems[0])}{more}") from error


def write_model(model: BaseModel, path: Path) -> None:
    """Write every field of `model`, including defaults, as YAML; atomically."""
    text = yaml.safe_dump(model.model_dump(), sort_keys=False, allow_unicode=True, width=120)
    with atomic_write(path) as partial:
        partial.write_text(text, encoding="utf-8")


def _explain(model: type[BaseModel], problem: ErrorDetails) -> str:
    field = _field_path(problem["loc"])
    if problem["type"] == "missing":
        return f"{field} is missing; add it"
    if problem["type"] == "extra_forbidden":
        given = _abbreviate(problem["input"])
        return f"{field} (given as {given}) is not a field; {_nearest_field(model, problem['loc'])}"
    message = problem["msg"].removeprefix("Value error, ")
    if problem["type"] == "value_error":  # messages of the project's validators name the way out
        return f"{field}: {message}" if field else message
    if problem["type"] == "model_type":
        message = "must have its own `field: value` lines"
    message = re.sub(r"^\w+ should ", "must ", message)
    return f"{field} is {_abbreviate(problem['input'])} but {message}; correct it"


def _field_path(location: tuple[int | str, ...]) -> str:
    path = ""
    for part in location:
        if part == "[key]":  # pydantic appends this if the key itself is invalid
            continue
        path += f"[{part}]" if isinstance(part, int) else f".{part}" if path else part
    return path


def _nearest_field(model: type[BaseModel], location: tuple[int | str, ...]) -> str:
    known = _fields_at(model, location[:-1])
    close = difflib.get_close_matches(str(location[-1]), known, n=1)
    if close:
        return f"did you mean {close[0]}?"
    return f"remove it, or use one of {', '.join(known)}"


def _fields_at(model: type[BaseModel], location: tuple[int | str, ...]) -> list[str]:
    """Return the names of the fields of the model at `location`."""
    current = model
    for part in location:
        if part not in current.model_fields:  # an index of a list, or a name in a mapping
            continue
        annotation = current.model_fields[str(part)].annotation
        candidates = [annotation, *getattr(annotation, "__args__", ())]
        current = next(kind for kind in candidates if isinstance(kind, type) and issubclass(kind, BaseModel))
    return list(current.model_fields)


def _abbreviate(value: object) -> str:
    text = _SHORT.repr(value)
    return text if len(text) <= _LONGEST_VALUE else f"{text[: _LONGEST_VALUE - 3]}..."
