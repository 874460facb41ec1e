"""Requirements beyond margin, α and decay. `figures` computes each of them for given gains; `predicted` does so with
prediction, and has the feed-forward of the command in front.

`parts`: the parts of a requirement. `norms`: gains from disturbance to spacing error and from noise to command.
`bound`: the α that no controller exceeds at a delay. `gains.design.for_delay` searches for gains that meet them.
"""
