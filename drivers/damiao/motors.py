"""What is known of Damiao motors: scales by type, status codes, temperatures.

The arm's own registers decide about scales; the table only says whether they look like a known
type. Sources: openarm_can (2026-08), where another source disagrees it says so.
"""

from __future__ import annotations

from dataclasses import dataclass

from drivers.damiao.codec import Limits

MOTOR_TYPES = {
    "DM4310": Limits(12.5, 30.0, 10.0),
    "DM4310P": Limits(12.5, 50.0, 10.0),  # and DM4310 48 V; Seeed gives 30 for the latter
    "DM4340": Limits(12.5, 10.0, 28.0),  # LeRobot, DM_Control_Python and Seeed: VMAX 8
    "DM8009": Limits(12.5, 45.0, 54.0),
    "DM3507": Limits(12.5, 50.0, 5.0),  # LeRobot: 30 and 10
    "DM6006": Limits(12.5, 45.0, 20.0),
    "DM8006": Limits(12.5, 45.0, 40.0),
    "DM10010L": Limits(12.5, 25.0, 200.0),
    "DM10010": Limits(12.5, 20.0, 200.0),
    "DMH3510": Limits(12.5, 280.0, 1.0),
    "DMH6215": Limits(12.5, 45.0, 10.0),
}
OPENARM = ("DM8009", "DM8009", "DM4340", "DM4340", "DM4310", "DM4310", "DM4310")

DISABLED, ENABLED, COMMUNICATION_LOST = 0x0, 0x1, 0xD


@dataclass(frozen=True)
class Status:
    """A status nibble.

    Attributes:
        name: in a few words.
        advice: what to do.
    """

    name: str
    advice: str


FAULTS = {
    0x5: Status("sensor error", "switch the motor off and on; if it stays, have it repaired"),
    0x6: Status("parameter error", "check its registers with the maker's tool"),
    0x8: Status("over-voltage", "check the supply; braking feeds energy back into it"),
    0x9: Status("under-voltage", "check the supply's voltage, current limit and cables"),
    0xA: Status("over-current", "check for a blocked joint, then switch the motor off and on"),
    0xB: Status("MOSFET over-temperature", "let it cool, then move slower or with less load"),
    0xC: Status("rotor over-temperature", "let it cool, then move slower or with less load"),
    0xD: Status(
        "communication lost",
        "it heard no command within its time-out (register 9) and let go; support the arm and "
        "connect again, which clears this",
    ),
    0xE: Status("overload", "reduce the load or the speed, then switch the motor off and on"),
}
UNDOCUMENTED = Status("undocumented status", "switch the motor off and on, and ask its maker")

# Own choice: the makers' pages give no figure for all types; 100 deg C is where winding insulation
# of the lowest usual class (A, 105 deg C, IEC 60085) comes close.
WARM_DEGC, HOT_DEGC = 80, 100


def fault_of(status: int) -> Status | None:
    """What is wrong with a motor of this status; None where it is enabled or disabled."""
    if status in (DISABLED, ENABLED):
        return None
    return FAULTS.get(status, UNDOCUMENTED)


def type_of(limits: Limits) -> str:
    """A type with these scales, or "unknown type"."""
    for name, known in MOTOR_TYPES.items():
        if limits == known:
            return name
    return "unknown type"
