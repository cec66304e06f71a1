"""Does a calibration still hold? Fresh pictures against what it says, and against how sure it says it is."""
