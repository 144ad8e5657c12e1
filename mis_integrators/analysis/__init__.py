"""Error metrics, variance maps and charts. Nothing here renders."""
