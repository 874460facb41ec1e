"""The designs: what is asked for is reached, or refused with what could be had."""
