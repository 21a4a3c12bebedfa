"""Message definitions of a log: taken from the file, as it has them; from what is generally known, where it has none."""

from __future__ import annotations

import struct
from typing import Any

from wlr_gym.base.errors import InputError

#: Types that ROS itself does not define and that old bags, which hold no definitions, are likely to have.
KNOWN = {
    "dynamixel_workbench_msgs/msg/DynamixelStateList": "DynamixelState[] dynamixel_state",
    "dynamixel_workbench_msgs/msg/DynamixelState": (
        "string name\nuint8 id\nint32 present_position\nint32 present_velocity\nint16 present_current"
    ),
}


class UnknownTypeError(InputError):
    """A type without a definition, in a file and in what is generally known."""


class Definitions:
    """Decodes messages of ROS 1 and 2."""

    def __init__(self) -> None:
        self._stores: dict[str, Any] = {}  # by type: two files may define one differently

    def define(self, kind: str, text: str, language: str = "ros2msg") -> None:
        """Take the definition of a type, with those of the types in it, as a file holds it.

        Raises:
            UnknownTypeError: it cannot be understood.
        """
        from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_types_from_msg, get_typestore

        store = get_typestore(Stores.EMPTY)
        try:
            found = _idl(text, get_types_from_idl) if language == "ros2idl" else get_types_from_msg(text, full_name(kind))
            store.register({name: fields for name, fields in found.items() if name not in store.fielddefs})
        except (TypesysError, KeyError, ValueError, AssertionError, TypeError) as error:
            raise UnknownTypeError(f"type '{kind}': its definition in the file cannot be understood: {error}") from None
        self._stores[full_name(kind)] = store

    def knows(self, kind: str) -> bool:
        """Whether a type is defined."""
        return full_name(kind) in self._stores

    def use_common(self, kind: str, ros2: bool) -> None:
        """Take the definition of a type that the file does not define from what is generally known of ROS 2, else 1.

        Raises:
            UnknownTypeError: it is not.
        """
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        name = full_name(kind)
        store = get_typestore(Stores.ROS2_HUMBLE if ros2 else Stores.ROS1_NOETIC)
        if name not in store.fielddefs and name in KNOWN:
            for known, text in KNOWN.items():
                store.register(get_types_from_msg(text, known))
        if name not in store.fielddefs:
            raise UnknownTypeError(f"type '{kind}': the file does not define it, and it is none that ROS comes with")
        self._stores[name] = store

    def decode(self, data: bytes, kind: str, ros2: bool) -> Any:
        """Return a message of ROS 2, else 1.

        Raises:
            ValueError: its bytes do not fit its definition.
        """
        from rosbags.serde import SerdeError

        name = full_name(kind)
        try:
            store = self._stores[name]
            return store.deserialize_cdr(data, name) if ros2 else store.deserialize_ros1(data, name)
        except (SerdeError, struct.error, IndexError, AssertionError, UnicodeDecodeError, MemoryError, KeyError) as error:
            raise ValueError(f"{type(error).__name__}: {error}") from None


def full_name(kind: str) -> str:
    """Return a type's name as ROS 2 writes it: ``sensor_msgs/msg/Imu``."""
    parts = kind.split("/")
    return kind if len(parts) != 2 else f"{parts[0]}/msg/{parts[1]}"


def _idl(text: str, parse: Any) -> dict[str, Any]:
    line = "=" * 80 + "\n"
    if not text.startswith(f"{line}IDL: "):
        return parse(text)
    found: dict[str, Any] = {}
    for part in text.split(line)[1:]:
        found |= parse(part.partition("\n")[2])
    return found
