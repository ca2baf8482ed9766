"""Error against time over every knob, one module per stage."""
