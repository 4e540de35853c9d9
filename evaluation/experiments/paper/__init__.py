"""The experiments of the paper's section 4, each with the paper's numbers beside ours."""
