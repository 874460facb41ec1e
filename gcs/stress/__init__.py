"""Campaigns: trials over link parameters, growth rates, the onset of instability, maps and their report."""
