"""A CAN arm of Damiao motors in MIT mode, as OpenArm uses them."""
