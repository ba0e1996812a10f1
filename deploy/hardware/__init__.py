"""The motors of a hand: their bus, registers, preflight and slow movements."""
