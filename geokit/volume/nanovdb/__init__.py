"""The bytes of one NanoVDB grid: layout, header, checks, file format, copies on devices."""
