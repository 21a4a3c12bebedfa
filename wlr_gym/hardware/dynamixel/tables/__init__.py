"""Servos, as data: one YAML file per model, read into :class:`ControlTable`; a model of your own is a file of the same form.

A file says what its series does not: ``model``, ``model_number``, ``series`` (a file of this folder, or beside its own),
``operating_modes``, ``changed`` rows, own rows, ``counts`` that differ, and the ``data_sheet`` of the motor.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any

from wlr_gym.base.errors import InputError, unknown_name
from wlr_gym.base.settings import SettingsModel, parse_config, read_yaml
from wlr_gym.physics.servo import CYCLE

#: Below this address items live in the EEPROM: kept without power, locked while torque is on.
FIRST_RAM_ADDRESS = 64
#: Bytes of address space; reading beyond is an access error.
TABLE_SIZE = 662
#: Turns that extended position mode counts, either way.
EXTENDED_TURNS = 256
#: Baud Rate register -> bits per second.
BAUD_RATES = (9600, 57600, 115200, 1_000_000, 2_000_000, 3_000_000, 4_000_000, 4_500_000)
# Values of Operating Mode.
CURRENT_MODE = 0
VELOCITY_MODE = 1
POSITION_MODE = 3
EXTENDED_POSITION_MODE = 4
CURRENT_POSITION_MODE = 5
PWM_MODE = 16
POSITION_MODES = (POSITION_MODE, EXTENDED_POSITION_MODE, CURRENT_POSITION_MODE)

# Bits of Hardware Error Status and Shutdown that the emulator sets.
INPUT_VOLTAGE = 0x01
OVERHEATING = 0x04
OVERLOAD = 0x20
#: Hardware Error Status and Shutdown bits.
HARDWARE_ERRORS = {
    INPUT_VOLTAGE: "input voltage",
    OVERHEATING: "overheating",
    0x08: "encoder",
    0x10: "electrical shock",
    OVERLOAD: "overload",
}
_RPM = 2.0 * math.pi / 60.0
_FOLDER = Path(__file__).parent
_SUFFIXES = (".yaml", ".yml")

Bound = int | str | None


def error_names(bits: int) -> list[str]:
    """Return the names of the errors in Hardware Error Status."""
    return [name for bit, name in HARDWARE_ERRORS.items() if bits & bit]


class Counts(SettingsModel):
    """What a count of a servo's registers is."""

    turn: int  #: counts of position per turn
    velocity: float  #: rpm
    acceleration: float  #: rpm per minute
    full_pwm: int  #: counts of the whole supply
    current: float  #: A
    load: float  #: share of the whole output
    voltage: float  #: V
    position_p_gain: float  #: counts of the gain that give a PWM count per count of the error
    velocity_p_gain: float  #: as the one before
    velocity_i_gain: float  #: as the one before, per count of the error's sum over cycles of 1 ms


class DataSheet(SettingsModel):
    """The motor at the voltage (V) that its figures hold for: stall torque (N m), no-load speed (rpm), stall current (A)."""

    voltage: float
    stall_torque: float
    no_load_rpm: float
    stall_current: float

    @property
    def no_load_speed(self) -> float:
        """Speed without load, rad/s."""
        return self.no_load_rpm * _RPM


@dataclass(frozen=True)
class Item:
    """One row of a control table."""

    name: str  #: spelled as in the e-manual, lower case with underscores
    address: int
    size: int  #: bytes
    signed: bool  #: two's complement
    writable: bool  #: False = read only
    default: Bound = None  #: count after a reset; a string names the item it is copied from; None = the servo sets it
    low: Bound = None  #: bound of a write in counts; a string names the item that is the bound, with ``-`` for its negative
    high: Bound = None
    quantity: str | None = None  #: unit: see :meth:`ControlTable.units`, ``degC``, ``ms``, ``2us``; None = a plain number

    @property
    def in_eeprom(self) -> bool:
        """Kept without power; locked while torque is on."""
        return self.address < FIRST_RAM_ADDRESS

    def encode(self, count: int) -> bytes:
        """Return ``count`` as the item's bytes.

        Raises:
            InputError: it does not fit.
        """
        try:
            return int(count).to_bytes(self.size, "little", signed=self.signed)
        except OverflowError:
            raise InputError(f"{self.name} = {count} does not fit {self.size} bytes") from None

    def decode(self, data: bytes | bytearray) -> int:
        """Return the count in the item's bytes."""
        return int.from_bytes(data[: self.size], "little", signed=self.signed)


@dataclass(frozen=True)
class ControlTable:
    """Control table of one servo model."""

    model: str  #: its name
    model_number: int  #: what a ping answers
    operating_modes: tuple[int, ...]  #: values Operating Mode takes
    items: Mapping[str, Item]  #: by name, in order of address
    counts: Counts  #: what they are
    data_sheet: DataSheet  #: of the motor
    supply: float  #: V that gains in V hold for: PWM is a part of it; the data sheet's, unless :meth:`at` says another

    def __getitem__(self, name: str) -> Item:
        if name not in self.items:
            raise unknown_name("control table item", name, self.items, self.model)
        return self.items[name]

    def at(self, supply: float) -> ControlTable:
        """Return the table of the same servo on another nominal supply (V)."""
        return replace(self, supply=supply)

    @cached_property
    def units(self) -> dict[str, float]:
        """Quantity -> SI value of one count: rad, rad/s, rad/s2, shares, A, V, and gains in V/rad and V s/rad."""
        counts = self.counts
        turn = 2.0 * math.pi
        position, velocity = turn / counts.turn, counts.velocity * turn / 60
        volt = self.supply / counts.full_pwm
        return {
            "position": position,
            "velocity": velocity,
            "profile_velocity": velocity,
            "profile_acceleration": counts.acceleration * turn / 3600,
            "pwm": 1 / counts.full_pwm,
            "current": counts.current,
            "load": counts.load,
            "voltage": counts.voltage,
            "position_p_gain": volt / counts.position_p_gain / position,
            "velocity_p_gain": volt / counts.velocity_p_gain / velocity,
            "velocity_i_gain": volt / counts.velocity_i_gain / (velocity * CYCLE),
        }

    def per_count(self, name: str) -> float:
        """Return the SI value of one count of item ``name``.

        Raises:
            InputError: unknown item, or one that is no physical quantity.
        """
        quantity = self[name].quantity
        if quantity is None or quantity not in self.units:
            raise InputError(f"{self.model} {name} has no SI unit")
        return self.units[quantity]

    @property
    def effort(self) -> str:
        """The item that tells of the motor's torque: Present Current, or Present Load where the servo measures none."""
        return "present_current" if "present_current" in self.items else "present_load"

    @property
    def extended_range(self) -> int:
        """Largest magnitude of Goal Position beyond position mode, counts."""
        return EXTENDED_TURNS * self.counts.turn - 1

    def voltage_range(self) -> tuple[float, float]:
        """Return the lowest and highest supply that the servo takes without an error, V."""
        counts = (self["min_voltage_limit"].low, self["max_voltage_limit"].high)
        low, high = (float(count) * self.counts.voltage for count in counts if isinstance(count, int))
        return low, high

    def block(self, first: str, last: str) -> tuple[int, int]:
        """Return address and length of the block from item ``first`` to item ``last``."""
        start, end = self[first], self[last]
        return start.address, end.address + end.size - start.address


@cache
def shipped_tables() -> dict[str, Path]:
    """Return the control tables that ship: servo model, such as ``XM540-W150-R`` -> file."""
    contents = {path: read_yaml(path) for path in sorted(_FOLDER.glob("*.yaml"))}
    return {content["model"]: path for path, content in contents.items() if "model" in content}


@cache
def load_table(model: str) -> ControlTable:
    """Load the control table of a servo model, for example ``XM540-W150-R``, or of a file of the same form.

    Raises:
        InputError: unknown model (the message lists those that ship), no such file, or a key that is missing or wrong.
    """
    own = model.endswith(_SUFFIXES)
    if not own and model not in shipped_tables():
        raise unknown_name("servo model", model, shipped_tables())
    path = Path(model) if own else shipped_tables()[model]
    data = read_yaml(path)
    for key in ("model", "model_number", "series", "operating_modes", "data_sheet"):
        if not isinstance(data, dict) or key not in data:
            raise InputError(f"{path}: '{key}' is missing: expected a servo, as {_FOLDER / 'xm540_w150.yaml'} describes one")
    series = _series(path, str(data["series"]))
    counts = parse_config(Counts, {**series.get("counts", {}), **data.get("counts", {})}, f"{path}: counts")
    sheet = parse_config(DataSheet, data["data_sheet"], f"{path}: data_sheet")
    changed = {**data.get("changed", {}), "model_number": {"default": data["model_number"]}}
    try:
        rows = [_item(row, changed) for part in (series, data) for area in ("eeprom", "ram") for row in part.get(area, ())]
        rows += [item for block in series["indirect"] for item in _indirect(*block)]
    except (TypeError, ValueError, KeyError, IndexError) as error:
        raise InputError(
            f"{path}: a row of the control table cannot be read: {error}; see {_FOLDER / 'x_series.yaml'}"
        ) from None
    rows.sort(key=lambda item: item.address)
    items = {item.name: item for item in rows}
    return ControlTable(
        data["model"], data["model_number"], tuple(data["operating_modes"]), items, counts, sheet, sheet.voltage
    )


def _series(path: Path, name: str) -> dict[str, Any]:
    beside = path.with_name(f"{name}.yaml")
    found = beside if beside.is_file() else _FOLDER / f"{name}.yaml"
    if not found.is_file():
        series = [other.stem for other in _FOLDER.glob("*_series.yaml")]
        raise unknown_name("series", name, series, str(path))
    return read_yaml(found)


def _item(row: list[Any], changed: Mapping[str, Mapping[str, Any]]) -> Item:
    address, kind, name, access, default, low, high, quantity = row
    item = Item(name, address, int(kind[1]), kind[0] == "i", access == "rw", default, low, high, quantity)
    return replace(item, **changed.get(name, {}))


def _indirect(number: int, address: int, data: int, count: int) -> Iterable[Item]:
    for k in range(count):
        pointer = (data + k, FIRST_RAM_ADDRESS, TABLE_SIZE - 1)
        yield Item(f"indirect_address_{number + k}", address + 2 * k, 2, False, True, *pointer)
        yield Item(f"indirect_data_{number + k}", data + k, 1, False, True, 0, 0, 255)
