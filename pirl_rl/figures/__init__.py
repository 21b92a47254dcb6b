"""All drawing. Figures are made without pyplot, so that no display and no global state is needed."""
