"""The bus: python-can, SecOC, CANopen, and bus logs that other programs wrote."""
