"""Random programs under random faults on the virtual board, judged by its truth.

``python -m tests.campaigns --runs 10000 --seed 0``; one run alone by ``--replay SEED``.
"""
