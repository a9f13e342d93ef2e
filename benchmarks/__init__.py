"""Measurements of speed and memory, most of which ``make bench`` runs.

``plateau``, ``intervals``, ``headings`` and ``clipped_actions`` measure none: they analyse artefacts and
published reports.
"""
