"""What a design can be asked for beside margin, α and decay: `figures` computes each of them for given gains;
`predicted` does so with prediction, and has the feed-forward of the command in front.

`poles`: the region of the roots. `norms`: gains from disturbance to spacing error and from noise to command. `bound`:
the α that no controller exceeds at a delay. `gains.design.for_delay` searches gains that meet them.
"""
