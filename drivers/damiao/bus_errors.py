"""Error frames of the Linux CAN stack as sentences; layout from linux/can/error.h."""

from __future__ import annotations

from dataclasses import dataclass

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
class BusTrouble:
    """One thing that an error frame says.

    Attributes:
        sentence: what happened and what to do.
        fatal: nothing can be sent or received any more.
    """

    sentence: str
    fatal: bool = False


def troubles_of(can_id: int, data: bytes | bytearray, channel: str) -> list[BusTrouble]:
    """Read an error frame: `can_id` has one bit for each class of error in it; one entry each."""
    if can_id & BUS_OFF:
        return [
            BusTrouble(
                f"{channel} is bus-off after too many errors: check cable, terminators and bit "
                f"rates, then restart it (ip link set {channel} down, then up, or type can "
                "restart-ms 100)",
                fatal=True,
            )
        ]
    said = [text for bit, text in CLASSES.items() if can_id & bit]
    if can_id & CONTROLLER:
        state = data[1] if len(data) > 1 else 0
        said += [text for bit, text in CONTROLLER_STATES.items() if state & bit] or [
            "the controller reports trouble without saying which"
        ]
    if can_id & RESTARTED:
        said.append("the controller was restarted after bus-off")
    return [
        BusTrouble(f"{channel}: {text}") for text in said or ["an error frame of no known class"]
    ]
