"""Frames of Damiao motors as a motor reads and writes them; the opposite side of a host's codec."""

from __future__ import annotations

from typing import NamedTuple

import can

FRAME_BYTES = 8
SERVICE_ID = 0x7FF  # register access, refresh and save; the motor's id is in the data

# Byte 7 after seven bytes FF.
CLEAR_ERROR, ENABLE, DISABLE, SET_ZERO = 0xFB, 0xFC, 0xFD, 0xFE
SPECIAL = bytes([0xFF] * 7)

# Byte 2 on SERVICE_ID.
READ, WRITE, SAVE, REFRESH = 0x33, 0x55, 0xAA, 0xCC
INTEGER_REGISTERS = frozenset({7, 8, 9, 10, 13, 14, 15, 16, 35, 36})  # the others are float32
BUS_OFF, BUS_ERROR = 0x040, 0x080  # error classes of Linux's linux/can/error.h


class FullScale(NamedTuple):
    """Full scale of a motor's angle (rad), speed (rad/s) and torque (N m)."""

    pmax: float
    vmax: float
    tmax: float


class MitCommand(NamedTuple):
    """What the motor law works with, in the motor's own angle."""

    q_des: float
    dq_des: float
    kp: float
    kd: float
    tau_ff: float


AT_REST = MitCommand(0.0, 0.0, 0.0, 0.0, 0.0)


def to_code(x: float, low: float, high: float, bits: int) -> int:
    """Code of x: clamped to [low, high], then truncated, as every source does."""
    top = (1 << bits) - 1
    return int((min(max(x, low), high) - low) / (high - low) * top)


def from_code(code: int, low: float, high: float, bits: int) -> float:
    """Value of a code."""
    return low + code / ((1 << bits) - 1) * (high - low)


def decode_command(data: bytes, scale: FullScale) -> MitCommand:
    """The eight bytes of a MIT command."""
    word = int.from_bytes(data, "big")
    pmax, vmax, tmax = scale
    return MitCommand(
        from_code(word >> 48, -pmax, pmax, 16),
        from_code(word >> 36 & 0xFFF, -vmax, vmax, 12),
        from_code(word >> 24 & 0xFFF, 0.0, 500.0, 12),  # N m/rad
        from_code(word >> 12 & 0xFFF, 0.0, 5.0, 12),  # N m s/rad
        from_code(word & 0xFFF, -tmax, tmax, 12),
    )


def encode_feedback(
    motor_id: int,
    status: int,
    motion: tuple[float, float, float],
    temperatures: tuple[float, float],
    scale: FullScale,
) -> bytes:
    """The eight bytes of a feedback frame.

    Args:
        motor_id: its low four bits are sent.
        status: nibble.
        motion: q rad, dq rad/s, torque N m.
        temperatures: of MOSFET and rotor, deg C, cut to 0..255.
        scale: of the motor.
    """
    q, dq, tau = motion
    word = (status & 0xF) << 4 | (motor_id & 0xF)
    word = word << 16 | to_code(q, -scale.pmax, scale.pmax, 16)
    word = word << 12 | to_code(dq, -scale.vmax, scale.vmax, 12)
    word = word << 12 | to_code(tau, -scale.tmax, scale.tmax, 12)
    for temperature in temperatures:
        word = word << 8 | min(max(int(temperature), 0), 255)
    return word.to_bytes(FRAME_BYTES, "big")


def data_frame(reply_id: int, data: bytes, fd: bool) -> can.Message:
    """A data frame with an 11-bit id; an FD frame has its bit-rate switch set."""
    return can.Message(
        arbitration_id=reply_id, data=data, is_extended_id=False, is_fd=fd, bitrate_switch=fd
    )


def error_frame(kind: int) -> can.Message:
    """An error frame as socketcan gives it to a receiver."""
    return can.Message(
        arbitration_id=kind, data=bytes(FRAME_BYTES), is_extended_id=False, is_error_frame=True
    )


def is_command(message: can.Message) -> bool:
    """Whether a motor can have an opinion on a message: 8 data bytes under an 11-bit id."""
    return not (
        message.is_error_frame
        or message.is_remote_frame
        or message.is_extended_id
        or len(message.data) != FRAME_BYTES
    )
