"""Hardware-in-the-loop bridge over CAN between a shock-absorber bench and a DART model."""
