"""
Data of other libraries, one module for each format.

To add a format, add a module to this folder with a constant ``FORMAT``, which is a
:class:`~sb3_offline.data.foreign.base.Format`. The registry finds the module by itself. ``d4rl`` is the shortest example.

All formats share four modules: ``base`` (what a format declares about itself), ``probe`` (what a path or an object contains),
``episodes`` (how transitions are cut into episodes, and how spaces are guessed) and ``recorded`` (how episodes that are stored
one by one are joined).
"""
