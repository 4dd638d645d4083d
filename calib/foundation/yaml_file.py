"""YAML read the strict way, and a pydantic model's complaints as one clear line."""

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
from groundsbot.calib.foundation.files import atomic_write

Model = TypeVar("Model", bound=BaseModel)

_LONGEST_VALUE = 60  # characters of a bad value worth repeating
_MOST_ALIASES: Final = 16  # of a text: each may stand for as much as all before it, so that few words fill any memory
# Characters: a second's work. Logs carry such texts, and anybody may have made a log.
LONGEST_TEXT: Final = 1 << 17
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)")


_SHORT = reprlib.Repr()  # never all of it: an alias named again and again may stand for gigabytes
_SHORT.maxlong = _SHORT.maxstring = _SHORT.maxother = _LONGEST_VALUE + 1
_SHORT.maxdict = _SHORT.maxlist = _SHORT.maxset = 12
_SHORT.maxlevel = 3


class _Loader(yaml.SafeLoader):
    """YAML 1.2's core scalars: 1e-3 is a number, `no` a word, 010 ten. A key given twice is an error."""

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
    """Replaces PyYAML's YAML 1.1 rules on our own loader only."""
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
    """The file's text.

    Raises:
        CalibError: it is missing, unreadable or not UTF-8.
    """
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise CalibError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    except UnicodeDecodeError as error:
        raise CalibError(f"{path}: is not text in UTF-8 (byte {error.start}); is this the right file?") from error


def parse_mapping(text: str, source: str, longest: int = LONGEST_TEXT) -> dict[str, Any]:
    """The one mapping that a YAML text holds.

    Args:
        text: YAML.
        source: what to call it in errors, usually the path.
        longest: how many characters it may have.

    Raises:
        CalibError: too long, not YAML, or not a mapping.
    """
    if len(text) > longest:
        raise CalibError(f"{source}: has {len(text)} characters, limit {longest}; is this the right file?")
    try:
        # A loader built on SafeLoader makes plain data only.
        data = yaml.load(text, Loader=_Loader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        place = f"line {mark.line + 1}, column {mark.column + 1}: " if mark else ""
        raise CalibError(f"{source}: {place}not valid YAML ({error.problem}); correct that line") from error
    except (yaml.YAMLError, RecursionError) as error:
        raise CalibError(f"{source}: not valid YAML ({error})") from error
    except (ValueError, TypeError, KeyError, AttributeError, IndexError) as error:  # of PyYAML's own constructors
        reason = " ".join(str(error).split())[:_LONGEST_VALUE]
        raise CalibError(f"{source}: not valid YAML ({reason}); write plain `field: value` lines") from error
    if not isinstance(data, dict):
        raise CalibError(f"{source}: holds {_abbreviate(data)} where fields were expected; write `field: value` lines")
    return cast(dict[str, Any], data)


def validate(model: type[Model], data: Mapping[str, Any], source: str) -> Model:
    """`data` as a `model`.

    Raises:
        CalibError: one line on the first thing wrong: file, field, value, limit, way out.
    """
    try:
        return model.model_validate(dict(data))
    except ValidationError as error:
        # A default worked out from a bad value is no mistake of its own.
        problems = [each for each in error.errors(include_url=False) if each["type"] != "default_factory_not_called"]
        more = f" (and {len(problems) - 1} more after that)" if len(problems) > 1 else ""
        raise CalibError(f"{source}: {_explain(model, problems[0])}{more}") from error


def write_model(model: BaseModel, path: Path) -> None:
    """Writes every field of `model`, defaults included, as YAML; whole or not at all."""
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
    if problem["type"] == "value_error":  # our own validators say the way out themselves
        return f"{field}: {message}" if field else message
    if problem["type"] == "model_type":
        message = "must have its own `field: value` lines"
    message = re.sub(r"^\w+ should ", "must ", message)
    return f"{field} is {_abbreviate(problem['input'])} but {message}; correct it"


def _field_path(location: tuple[int | str, ...]) -> str:
    path = ""
    for part in location:
        if part == "[key]":  # pydantic's way to say that the key itself is wrong
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
    """Names of the fields of the model that `location` leads to."""
    current = model
    for part in location:
        if isinstance(part, int):
            continue
        annotation = current.model_fields[part].annotation
        candidates = [annotation, *getattr(annotation, "__args__", ())]
        current = next(kind for kind in candidates if isinstance(kind, type) and issubclass(kind, BaseModel))
    return list(current.model_fields)


def _abbreviate(value: object) -> str:
    text = _SHORT.repr(value)
    return text if len(text) <= _LONGEST_VALUE else f"{text[: _LONGEST_VALUE - 3]}..."
