"""Control mathematics of formations: gains for an information pattern, and the delay that their loops take.

Nothing is imported here; each module is imported by its name. Matrices are arrays or nested lists, A, B, K with the
feedback u = +K x; times in s, frequencies in rad/s, state matrices in 1/s. Exceptions are in `errors`.

Loops with a constant delay
    `delay` (windows and margin, exact), `delay_sweep`, `rightmost`, `delay_opinions` (what confirms it),
    `commensurate` and `mixed_delays` (multiples of one delay, beside known ones), `several_delays`, `model_file` and
    `loop_margin` (any of these, and sampled loops, from one description)
Loops as they are flown
    `sampled` (sampled and held), `period_windows`, `multirate`, `onboard`, `response` (vehicles that lag),
    `flown_loop` (what a delay leaves of robustness and string stability)
Delays that vary
    `varying_delay`, `jitter` (which bound covers what was observed)
Formations and patterns
    `formation`, `pattern`, `fixed_modes`, `string_stability`, `behaviour`, `structure` (blocks that really interact)
Designs
    `design` (one call for both routes), `requirement`; by the inclusion principle: `inclusion`,
    `robust`, `required`, `search`, `scalar_gains`;
    by graphs: `graph_design`, `bipartite`, `lqr`, `structured_lqr`, `dk_iteration`; to compare with: `centralised`
Inside
    `lmi` (inequalities with a proof that is checked); crossings and loci of the loops in the modules not named here

Examples
--------
Gains for a leader and two followers that take 0.3 s at 50 Hz; without sampling the loop takes half a period more:

>>> from gains.delay.constant import delay_margin
>>> from gains.design.design import design
>>> from gains.formation.model import FormationModel
>>> from gains.core.requirement import Requirement
>>> chain = FormationModel((-1, 0, 1))
>>> found = design(chain, Requirement(delay_margin_s=0.3), period_s=0.02)
>>> round(found.delay_margin_s, 3), round(delay_margin(*chain.ground_loop(found.K1, found.K2, found.K3)), 3)
(0.3, 0.31)
"""
