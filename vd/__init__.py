"""Core of Visual Dexterity on Newton: simulation, task, evaluation, viewing and benchmarks."""
