"""Generates parts of the documentation: the reference from the code, the figures from the commands behind them.

A page is written by hand and has blocks to fill in, each between two comments that the reader does not see::

    <!-- generated: NAME -->
    <!-- end -->

`blocks` finds and fills them. `reference` makes the blocks of the reference (with `keys` and `api`), and
`measurements` lists and makes those with figures. `__main__` is the command behind `python3 make.py reference`
and `measurements`. `pictures` makes the pictures. `runner` runs the commands behind figures and pages, in processes
that `forked` makes from one that is `preloaded`; `sessions` finds what a page says to type. The other files each
make one kind of block: hence more than twelve.
"""
