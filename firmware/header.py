"""Write ``wlr_board/frames.h``, the frames as the firmware sees them, from the one description that readers and emulator use.

``python firmware/header.py`` writes it; ``tests/firmware`` compares.
"""

from __future__ import annotations

from pathlib import Path

from wlr_gym.hardware.serial_frames import FIRMWARE_VERSION, FORMATS, SENSORS, STATUS_REQUEST, FrameFormat

HEADER = Path(__file__).parent / "wlr_board" / "frames.h"
TYPES = {"B": "uint8_t", "x": "uint8_t", "h": "int16_t", "H": "uint16_t", "I": "uint32_t"}


def frame(name: str, format: FrameFormat) -> str:
    """Return the C of one kind of frame: its sync and its bytes, which an AVR has in the order of the line."""
    fields = "".join(f"    {TYPES[kind]} {field};\n" for field, kind in format.fields.items())
    sync = "".join(f"#define {name.upper()}_SYNC_{k} {byte:#04x}\n" for k, byte in enumerate(format.sync))
    members = f"    uint8_t sync[2];\n{fields}    uint16_t crc;\n"
    return f"{sync}typedef struct __attribute__((packed)) {{\n{members}}} {name}_frame_t;\n"


def header() -> str:
    """Return the whole header."""
    major, minor = FIRMWARE_VERSION
    numbers = {"VERSION_MAJOR": major, "VERSION_MINOR": minor}
    numbers |= {f"REQUEST_{k}": byte for k, byte in enumerate(STATUS_REQUEST)}
    numbers |= {f"SENSOR_{name.upper()}": bit for name, bit in SENSORS.items()}
    return "\n".join(
        (
            "/* Written by firmware/header.py from wlr_gym/hardware/serial_frames.py: change it there. */",
            "#ifndef FRAMES_H\n#define FRAMES_H\n\n#include <stdint.h>\n",
            "".join(f"#define {name} {value:#04x}\n" for name, value in numbers.items()),
            *(frame(name, format) for name, format in FORMATS.items()),
            "#endif\n",
        )
    )


if __name__ == "__main__":
    HEADER.write_text(header())
