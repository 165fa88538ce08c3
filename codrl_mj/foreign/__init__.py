"""Motors in environments of others: Gymnasium's, dm_control's, and whatever builds its model from XML."""
