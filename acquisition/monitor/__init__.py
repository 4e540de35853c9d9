"""A session to look at: the live page of `acquire monitor`, and the report that stays when the session is over."""
