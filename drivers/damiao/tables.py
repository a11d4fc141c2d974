"""What codes mean and what to do: motor types, status, temperatures, errors of the CAN stack.

The arm's own registers decide about scales; the table of types only says whether they look like a
known one. Sources: openarm_can (2026-08), where another source disagrees it says so; error frames
of Linux: linux/can/error.h.
"""

from __future__ import annotations

from dataclasses import dataclass

from drivers.damiao.codec import Scales

MOTOR_TYPES = {
    "DM4310": Scales(12.5, 30.0, 10.0),
    "DM4310P": Scales(12.5, 50.0, 10.0),  # and DM4310 48 V; Seeed gives 30 for the latter
    "DM4340": Scales(12.5, 10.0, 28.0),  # LeRobot, DM_Control_Python and Seeed: VMAX 8
    "DM8009": Scales(12.5, 45.0, 54.0),
    "DM3507": Scales(12.5, 50.0, 5.0),  # LeRobot: 30 and 10
    "DM6006": Scales(12.5, 45.0, 20.0),
    "DM8006": Scales(12.5, 45.0, 40.0),
    "DM10010L": Scales(12.5, 25.0, 200.0),
    "DM10010": Scales(12.5, 20.0, 200.0),
    "DMH3510": Scales(12.5, 280.0, 1.0),
    "DMH6215": Scales(12.5, 45.0, 10.0),
}
OPENARM = ("DM8009", "DM8009", "DM4340", "DM4340", "DM4310", "DM4310", "DM4310")

DISABLED, ENABLED, COMMUNICATION_LOST = 0x0, 0x1, 0xD
# Own choice: the makers' pages give no figure for all types; 100 deg C is where winding insulation
# of the lowest usual class (A, 105 deg C, IEC 60085) comes close.
WARM_DEGC, HOT_DEGC = 80, 100
BUS_OFF, RESTARTED, CONTROLLER = 0x040, 0x100, 0x004
CLASSES = {
    0x001: "a frame could not be sent in time; is a motor switched on, the bus terminated?",
    0x002: "arbitration was lost; harmless unless frequent",
    0x008: "a frame broke the protocol; check bit rates and sample points on both sides",
    0x010: "the transceiver reports trouble; check the wiring of CAN_H and CAN_L",
    0x020: "nobody acknowledged a frame; check the motors' power, the cable and the bit rate",
    0x080: "a bit error on the bus; check cable, terminators and bit rates",
    0x200: "the error counters changed",
}
CONTROLLER_STATES = {
    0x01: "frames were lost because the receive buffer was full",
    0x02: "frames were lost because the transmit buffer was full",
    0x04: "many receive errors (warning level); check cable, terminators and bit rates",
    0x08: "many transmit errors (warning level); check cable, terminators and bit rates",
    0x10: "receive errors made the controller passive; check cable, terminators and bit rates",
    0x20: "transmit errors made the controller passive; check cable, terminators and bit rates",
    0x40: "the controller has recovered from its errors",
}


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


def fault_of(status: int) -> Status | None:
    """What is wrong with a motor of this status; None where it is enabled or disabled."""
    if status in (DISABLED, ENABLED):
        return None
    unknown = Status("undocumented status", "switch the motor off and on, and ask its maker")
    return FAULTS.get(status, unknown)


def type_of(limits: Scales) -> str:
    """A type with these scales, or "unknown type"."""
    for name, known in MOTOR_TYPES.items():
        if limits == known:
            return name
    return "unknown type"


def troubles_of(can_id: int, data: bytes | bytearray, channel: str) -> list[str]:
    """Read an error frame: `can_id` has one bit for each class of error in it; a sentence each.

    After `BUS_OFF` nothing can be sent or received any more.
    """
    if can_id & BUS_OFF:
        return [
            f"{channel} is bus-off after too many errors: check cable, terminators and bit rates, "
            f"then restart it (ip link set {channel} down, then up, or type can restart-ms 100)"
        ]
    said = [text for bit, text in CLASSES.items() if can_id & bit]
    if can_id & CONTROLLER:
        state = data[1] if len(data) > 1 else 0
        said += [text for bit, text in CONTROLLER_STATES.items() if state & bit] or [
            "the controller reports trouble without saying which"
        ]
    if can_id & RESTARTED:
        said.append("the controller was restarted after bus-off")
    return [f"{channel}: {text}" for text in said or ["an error frame of no known class"]]
