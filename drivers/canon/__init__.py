"""Canon EOS bodies over PTP: their records, their state, their release."""
