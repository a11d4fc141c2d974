"""python-can messages as these boards send them."""

from __future__ import annotations

import can

from sim.damiao.codec import FRAME_BYTES

BUS_OFF, BUS_ERROR = 0x040, 0x080  # error classes of Linux's linux/can/error.h


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
