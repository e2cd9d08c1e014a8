"""People answer: one front end on a page and in a notebook, clips, and computation ahead of the answers.

session            one sitting: the learner, the people who answer, and the thread that computes; seat: one of them
views              what is shown at each turn, as plain data
page, widget       the hosts of the front end (front.css, front.js): a web server, and a notebook's cell
clips              pictures of the parts of trajectories that are compared
drawing, plots     how a picture is made: of an environment with a drawing, of one without; replay: by itself
practice           instructions and practice questions before the first
foresight          the next questions, computed before the answer is given
"""
