"""What the filter is: functions and arrays, never a valve."""
