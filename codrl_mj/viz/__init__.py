"""Pictures of what happened: films, replays, live views and pages."""
