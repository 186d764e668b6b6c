"""Parameters as people and tools give them, in the type that the node declared.

``60`` for a double is an integer to ROS; ``ros2 param dump`` writes ``null`` where an array was
left out, and a file gives that back as a text; ``ros2 param load`` sends every value as the text
that Python makes of it, so that ``5.0e-05`` comes as the text ``5e-05``. None of these can be
mistaken for another value, so they are taken for what they say. Everything else keeps its type.
"""

from __future__ import annotations

from rclpy.parameter import Parameter

from hpid_ros.errors import SettingError

_Type = Parameter.Type
_UNSET = ("null", "~", "None")
_WORDS = {
    _Type.BOOL: "true or false",
    _Type.INTEGER: "an integer",
    _Type.DOUBLE: "a double",
    _Type.STRING: "a text",
    _Type.BYTE_ARRAY: "an array of bytes",
    _Type.BOOL_ARRAY: "an array of true and false",
    _Type.INTEGER_ARRAY: "an array of integers",
    _Type.DOUBLE_ARRAY: "an array of doubles",
    _Type.STRING_ARRAY: "an array of texts",
}


def as_declared(given: Parameter, kind: Parameter.Type) -> Parameter:
    """Return a parameter that was given in the type that was declared.

    Args:
        given: As it came.
        kind: The declared type; ``NOT_SET`` takes any.

    Returns:
        Of the declared type, or of type ``NOT_SET`` where nothing was given.

    Raises:
        SettingError: It is of another type, and says nothing that the declared one could mean.
    """
    if given.type_ == kind or kind == _Type.NOT_SET:
        return given
    if kind in (_Type.DOUBLE, _Type.DOUBLE_ARRAY):
        given = _numbers(given, kind)
    if kind.name.endswith("_ARRAY") and _is_empty(given):
        return Parameter(given.name, kind, [])
    if given.type_ == kind:
        return given
    if given.type_ == _Type.NOT_SET or (given.type_ == _Type.STRING and given.value in _UNSET):
        return Parameter(given.name)
    quotes = f", written '{given.value}'" if kind == _Type.STRING else ""
    raise SettingError(
        f"{given.name} must be {_WORDS[kind]}{quotes}, "
        f"not {_WORDS[given.type_]} ({_shown(given.value)})"
    )


def is_same(present: Parameter, change: Parameter) -> bool:
    """Tell whether a change would change nothing.

    Args:
        present: The parameter as the node has it.
        change: Of the declared type.
    """
    return bool(present.get_parameter_value() == change.get_parameter_value())


def _numbers(given: Parameter, kind: Parameter.Type) -> Parameter:
    """Return numbers as doubles, whatever they were written as; what is none unchanged."""
    value = given.value
    try:
        if kind == _Type.DOUBLE and given.type_ in (_Type.INTEGER, _Type.STRING):
            return Parameter(given.name, kind, float(value))
        if kind == _Type.DOUBLE_ARRAY and given.type_ == _Type.INTEGER_ARRAY:
            return Parameter(given.name, kind, [float(each) for each in value])
        if kind == _Type.DOUBLE_ARRAY and given.type_ == _Type.STRING and value[:1] == "[":
            return Parameter(given.name, kind, [float(each) for each in value[1:-1].split(",")])
    except ValueError:
        pass
    return given


def _is_empty(given: Parameter) -> bool:
    """Tell whether an empty array was given, which has no type: YAML makes booleans of it."""
    return given.type_ == _Type.BOOL_ARRAY and not len(given.value)


def _shown(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
