"""The conversation with one vehicle: clocks, sequence numbers, codec and uploads."""
