"""What a design can be asked for beside margin, robustness and decay."""
