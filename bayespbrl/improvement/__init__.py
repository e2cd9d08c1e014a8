"""Step 2: from the utility to a better policy, by actor-critic REPS.

q_function  the critic: Q of transitions by LSTD
lstd        the linear algebra of LSTD
reps        sample weights that raise Q within a KL bound: the dual (eqs. 11-13)
whitening   the features of its constraint, whitened
problem     how the policy is updated, and the data of an iteration's updates
update      the actor: propose an update, apply it within a bound (eq. 14)
schedules   the bound of each update: constant, or by confidence
check       whether a policy is better than another, by the utility of what they do
"""
