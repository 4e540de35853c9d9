"""What a dataset says of itself to people and catalogues: card, datasheet, Croissant; a lab completes them by hand."""
