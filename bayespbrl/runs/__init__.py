"""A run on disk, and back.

run                      start it, resume it, load it; utility_reward: its utility as the reward of another learner
directory, files         what is written where, and how; iteration_files, stored_classes: arrays, and classes by name
lock                     one process continues it at a time
answers_file, film       answers and episodes for other programs
simulated                who answers a run that needs nobody
"""
