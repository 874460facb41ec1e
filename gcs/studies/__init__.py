"""Questions answered by designing and flying: comparison of routes, the source's figures, link capacity, speed."""
