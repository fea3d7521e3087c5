"""Devices on USB, spoken to through pyusb."""
