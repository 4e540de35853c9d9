"""Light as the CIE's standard observer sees it."""
