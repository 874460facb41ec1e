"""Questions answered by designing and flying: design routes compared, the source's figures, link capacity, speed."""
