"""Seeded damage to every kind of file a user gives or keeps: each must end in one clear line.

A tool of the repository, no part of the package: ``make fuzz``.
"""
