"""What people and other programs see of a run while it goes: page, Foxglove's protocol, table."""
