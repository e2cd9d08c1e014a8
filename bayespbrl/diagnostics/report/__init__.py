"""The report of a run: one HTML or Markdown file.

write                       reads a run, fills the template, writes the file
contents, log               what can be read of a run directory
tables, figures             data sets and the figures of them
sections, answers, utility  the sections
summary, warnings           what stands at the head
document                    sections, tables and pictures as data
"""

from bayespbrl.diagnostics.report.write import write_report

__all__ = ["write_report"]
