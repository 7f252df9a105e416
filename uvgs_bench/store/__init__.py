"""What is on disk: documents people write and runs the bench records.

Here: strict readers, the run journal, workspaces. In: paths. Out: values of the rooms below. Plug point: none.
"""
