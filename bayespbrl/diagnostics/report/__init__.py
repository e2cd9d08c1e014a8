"""The diagnostic report of a run: one HTML or Markdown file.

write                       reads a run, fills the template, writes the file
contents, log               what can be read of a run directory
tables, figures             data sets, and figures of them
sections, answers, utility, people   the sections
summary, warnings           the sentences and warnings at the head
document, formatting        a report as data, and numbers as text
"""

from bayespbrl.diagnostics.report.write import write_report

__all__ = ["write_report"]
